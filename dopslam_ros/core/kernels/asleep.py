"""Which scattering points the vehicle has left behind."""

from __future__ import annotations

import math

import numpy as np

from dopslam_ros.core.arrays import BoolArray, FloatArray, IntArray
from dopslam_ros.core.kernels.channel import SP
from dopslam_ros.core.kernels.compiled import compiled
from dopslam_ros.core.kernels.placement import place, place_jacobian

UE = 4


@compiled
def left_behind(
    mean: FloatArray,
    covariance: FloatArray,
    origin: FloatArray,
    axes: FloatArray,
    component_track: IntArray,
    component_type: IntArray,
    view: float,
    margin: float,
    hysteresis: float,
    reach: FloatArray,
    leaving: BoolArray,
) -> bool:
    """Tracks of which every component is an SP too far away to be detected.

    Args:
        mean: (4 + 3 C,).
        covariance: (4 + 3 C, 4 + 3 C).
        origin: (C, 3) of the components' frames [m].
        axes: (C, 3, 3).
        component_track: (C,).
        component_type: (C,).
        view: the field of view [m].
        margin: standard deviations beyond it at which a detection is out of the question.
        hysteresis: how much farther away they must be [m].
        reach: (C,) result: the distance at which they must be awake again [m].
        leaving: (T,) result.

    Returns:
        Whether there is any.
    """
    blur = margin * math.sqrt(covariance[0, 0] + covariance[1, 1])
    leaving[:] = True
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
        reach[c] = view + margin * math.sqrt(max(spread, 0.0))
        distance = math.hypot(position[0] - mean[0], position[1] - mean[1])
        if component_type[c] != SP or distance <= reach[c] + blur + hysteresis:
            leaving[component_track[c]] = False
    return bool(leaving.any())
