"""Which scattering points the vehicle has left behind."""

from __future__ import annotations

import math

from dopslam_ros.core.arrays import BoolArray, FloatArray, IntArray
from dopslam_ros.core.channel import LandmarkType
from dopslam_ros.core.kernels.compiled import compiled

UE = 4
SP = int(LandmarkType.SP)


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
    for c in range(len(component_track)):
        at = UE + 3 * c
        u, v = mean[at + 1], mean[at + 2]
        length = math.sqrt(1.0 + u * u + v * v)
        ray = (1.0 / length, u / length, v / length)
        x, y = origin[c, 0], origin[c, 1]
        for i in range(3):
            x += mean[at] * axes[c, 0, i] * ray[i]
            y += mean[at] * axes[c, 1, i] * ray[i]
        # The trace of J P J'; the axes do not change it.
        spread = 0.0
        for i in range(3):
            row_0 = ray[i]
            row_1 = mean[at] / length * ((1.0 if i == 1 else 0.0) - ray[i] * ray[1])
            row_2 = mean[at] / length * ((1.0 if i == 2 else 0.0) - ray[i] * ray[2])
            spread += (
                row_0 * row_0 * covariance[at, at]
                + row_1 * row_1 * covariance[at + 1, at + 1]
                + row_2 * row_2 * covariance[at + 2, at + 2]
                + 2.0 * row_0 * row_1 * covariance[at, at + 1]
                + 2.0 * row_0 * row_2 * covariance[at, at + 2]
                + 2.0 * row_1 * row_2 * covariance[at + 1, at + 2]
            )
        reach[c] = view + margin * math.sqrt(max(spread, 0.0))
        distance = math.hypot(x - mean[0], y - mean[1])
        if component_type[c] != SP or distance <= reach[c] + blur + hysteresis:
            leaving[component_track[c]] = False
    return bool(leaving.any())
