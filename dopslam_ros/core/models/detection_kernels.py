"""What can be detected from where, and what is left undetected."""

from __future__ import annotations

import math

from dopslam_ros.core.linalg.arrays import FloatArray, IntArray
from dopslam_ros.core.linalg.jit import from_python, jit
from dopslam_ros.core.settings.layout import SP


@from_python
def detection_probabilities(
    ue: FloatArray,
    positions: FloatArray,
    types: IntArray,
    spread: FloatArray,
    probability: float,
    view: float,
    detection: FloatArray,
) -> None:
    """``detection_probability`` of M landmarks, into detection (M,).

    Args:
        ue: (3,) position of the vehicle [m].
        positions: (M, 3) [m].
        types: (M,) LandmarkType.
        spread: (M,) standard deviations of the distances [m].
        probability: p_D of a visible landmark.
        view: field of view for SPs [m].
        detection: (M,) to be written.
    """
    for m in range(len(types)):
        distance = distance_between(ue[0], ue[1], ue[2], positions[m])
        detection[m] = detection_probability(types[m], distance, spread[m], probability, view)


# A distance that is better known than this [m] is as good as exact.
SMALLEST_SPREAD = 1e-9


@jit
def detection_probability(
    kind: int, distance: float, spread: float, probability: float, view: float
) -> float:
    """p_D of one landmark.

    Args:
        kind: LandmarkType.
        distance: from the vehicle [m].
        spread: standard deviation of the distance [m]; 0 where it is exact.
        probability: p_D of a visible landmark.
        view: field of view for SPs [m].
    """
    if kind != SP:
        return probability
    if spread <= SMALLEST_SPREAD:
        return probability if distance <= view else 0.0
    return probability * 0.5 * math.erfc((distance - view) / (spread * math.sqrt(2.0)))


@jit
def distance_between(x: float, y: float, z: float, position: FloatArray) -> float:
    """Distance of a point from position (3,) [m]."""
    dx, dy, dz = position[0] - x, position[1] - y, position[2] - z
    return math.sqrt(dx * dx + dy * dy + dz * dz)
