"""The EK-PMB SLAM filter of Ge et al. as pure functions over arrays."""

from dopslam_ros.core.filter.state import (
    FilterParameters,
    FilterState,
    LandmarkEstimates,
    initial_filter_state,
    reported_landmarks,
)
from dopslam_ros.core.filter.step import Associations, Step, step

__all__ = [
    "Associations",
    "FilterParameters",
    "FilterState",
    "LandmarkEstimates",
    "Step",
    "initial_filter_state",
    "reported_landmarks",
    "step",
]
