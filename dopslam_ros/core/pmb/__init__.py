"""The EK-PMB(M) SLAM filter of Ge et al. as pure functions over arrays."""

from dopslam_ros.core.pmb.density import Density
from dopslam_ros.core.pmb.estimates import LandmarkEstimates, reported_landmarks
from dopslam_ros.core.pmb.observed import prepare
from dopslam_ros.core.pmb.posterior import Posterior, initial_density, initial_posterior
from dopslam_ros.core.pmb.step import step
from dopslam_ros.core.pmb.step_kernels import Associations
from dopslam_ros.core.settings.filtering import FilterParameters

__all__ = [
    "Associations",
    "Density",
    "FilterParameters",
    "LandmarkEstimates",
    "Posterior",
    "initial_density",
    "initial_posterior",
    "prepare",
    "reported_landmarks",
    "step",
]
