"""The EK-PMB(M) SLAM filter of Ge et al. as pure functions over arrays."""

from dopslam_ros.core.pmb.estimates import LandmarkEstimates, reported_landmarks
from dopslam_ros.core.pmb.pmbm import (
    Mixture,
    MixtureStep,
    initial_mixture,
    landmarks_of,
    mixture_step,
)
from dopslam_ros.core.pmb.state import FilterState, initial_filter_state
from dopslam_ros.core.pmb.step import Step, step
from dopslam_ros.core.pmb.step_kernels import Associations
from dopslam_ros.core.settings.filtering import FilterParameters

__all__ = [
    "Associations",
    "FilterParameters",
    "FilterState",
    "LandmarkEstimates",
    "Mixture",
    "MixtureStep",
    "Step",
    "initial_filter_state",
    "initial_mixture",
    "landmarks_of",
    "mixture_step",
    "reported_landmarks",
    "step",
]
