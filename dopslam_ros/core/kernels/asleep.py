"""Which scattering points the vehicle has left behind."""

from __future__ import annotations

import math

import numpy as np

from dopslam_ros.core.arrays import BoolArray, FloatArray
from dopslam_ros.core.kernels.channel import SP
from dopslam_ros.core.kernels.compiled import compiled, part
from dopslam_ros.core.kernels.placement import place, place_jacobian
from dopslam_ros.core.kernels.records import UE, Density

# Standard deviations beyond the field of view at which a detection is out of the question.
MARGIN = 5.0
# A landmark falls asleep this share of the field of view farther away than it wakes up.
HYSTERESIS = 0.1


@part
def some_left_behind(density: Density, view: float) -> bool:
    """Whether there is any track that ``left_behind`` finds."""
    _, leaving = left_behind(density, view)
    for one in leaving:
        if one:
            return True
    return False


@compiled
def left_behind(density: Density, view: float) -> tuple[FloatArray, BoolArray]:
    """Tracks of which every component is an SP too far away to be detected.

    Args:
        density: after a step.
        view: the field of view [m].

    Returns:
        (C,) the distance at which the components must be awake again [m], and (T,) which tracks
        are left behind.
    """
    mean, covariance = density.mean, density.covariance
    origin, axes = density.origin, density.axes
    component_track, component_type = density.component_track, density.component_type
    reach = np.empty(len(component_track))
    leaving = np.full(len(density.track_id), True)
    blur = MARGIN * math.sqrt(covariance[0, 0] + covariance[1, 1])
    position, jacobian = np.empty(3), np.empty((3, 3))
    for c in range(len(component_track)):
        at = UE + 3 * c
        place(origin[c], axes[c], mean[at : at + 3], position)
        place_jacobian(axes[c], mean[at : at + 3], jacobian)
        spread = 0.0  # the trace of J P J'
        for i in range(3):
            for k in range(3):
                for j in range(3):
                    spread += jacobian[i, k] * covariance[at + k, at + j] * jacobian[i, j]
        reach[c] = view + MARGIN * math.sqrt(max(spread, 0.0))
        distance = math.hypot(position[0] - mean[0], position[1] - mean[1])
        if component_type[c] != SP or distance <= reach[c] + blur + HYSTERESIS * view:
            leaving[component_track[c]] = False
    return reach, leaving
