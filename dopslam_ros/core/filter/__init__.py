"""The EK-PMB(M) SLAM filter of Ge et al. as pure functions over arrays."""

from dopslam_ros.core.filter.estimates import LandmarkEstimates, reported_landmarks
from dopslam_ros.core.filter.mixture import (
    Mixture,
    MixtureStep,
    initial_mixture,
    landmarks_of,
    mixture_step,
)
from dopslam_ros.core.filter.state import (
    FilterParameters,
    FilterState,
    initial_filter_state,
)
from dopslam_ros.core.filter.step import Step, step
from dopslam_ros.core.kernels.records import Associations

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
