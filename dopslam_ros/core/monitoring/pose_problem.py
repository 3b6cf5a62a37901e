"""What a search for the pose is given: a set of paths, the landmarks and the sensor.

What a pose is here are the components of the vehicle that a set of paths can tell: x, y, heading
and clock bias.
"""

from __future__ import annotations

from typing import NamedTuple

from dopslam_ros.core.linalg.arrays import BoolArray, FloatArray, IntArray
from dopslam_ros.core.settings.layout import CLOCK_BIAS, HEADING, X, Y

# The first components of the vehicle's state.
POSE = (X, Y, HEADING, CLOCK_BIAS)


class Clock(NamedTuple):
    """What is known of the clock bias before a set: mean and standard deviation [m]."""

    mean: float
    std: float


class Landmarks(NamedTuple):
    """L landmarks, the BS first.

    Attributes:
        position: (L, 3) [m].
        covariance: (L, 3, 3) [m^2].
        kind: (L,) LandmarkType.
        log_detection: (L,) ln of the probability of a path where it is in view.
    """

    position: FloatArray
    covariance: FloatArray
    kind: IntArray
    log_detection: FloatArray


class Paths(NamedTuple):
    """J paths.

    Attributes:
        values: (J, 6) NaN where not used.
        used: (J, 6).
        noise: (J, 6, 6).
        log_clutter: (J,) ln of the intensity of a path that is no landmark's.
        possible: (L, J) whether it may be the landmark's at all, whatever the pose.
    """

    values: FloatArray
    used: BoolArray
    noise: FloatArray
    log_clutter: FloatArray
    possible: BoolArray


class Problem(NamedTuple):
    """What is known of a set and of the world, but for the pose.

    Attributes:
        bs: (3,) [m].
        ue_height: [m].
        speed: v [m/s].
        sp_field_of_view: [m].
        gates: (7,) squared distances inside which a path lies, by its number of components.
        clock: the clock bias before.
        landmarks: that may be heard.
        paths: of the set.
    """

    bs: FloatArray
    ue_height: float
    speed: float
    sp_field_of_view: float
    gates: FloatArray
    clock: Clock
    landmarks: Landmarks
    paths: Paths
