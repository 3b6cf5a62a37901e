"""What can be detected from where, and what is left undetected."""

from __future__ import annotations

import math

import numpy as np

from dopslam_ros.core.linalg.arrays import FloatArray, IntArray
from dopslam_ros.core.models.channel_kernels import SP
from dopslam_ros.core.linalg.jit import compiled, part
from dopslam_ros.core.pmb.records import Undetected

# A distance that is better known than this [m] is as good as exact.
SMALLEST_SPREAD = 1e-9
# Even what is always detected leaves a chance to have been missed.
LARGEST_PROBABILITY = 1.0 - 1e-9
# Viewpoints nearer to each other than this share of the field of view count as one.
SPACING = 0.1
# More than any field of view needs; the oldest go first.
MOST_VIEWPOINTS = 400


@part
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


@compiled
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
        distance = apart(ue[0], ue[1], ue[2], positions[m])
        detection[m] = detection_probability(types[m], distance, spread[m], probability, view)


@part
def log_share_left(
    undetected: Undetected,
    ue_height: float,
    position: FloatArray,
    kind: int,
    spread: float,
    probability: float,
    view: float,
    floor: float,
) -> float:
    """ln of the share of undetected landmarks left at a place.

    Args:
        undetected: from where how often nothing new was detected.
        ue_height: z of the vehicle's antenna [m].
        position: (3,) [m].
        kind: VA or SP.
        spread: standard deviation of the distance [m].
        probability: p_D of a visible landmark.
        view: field of view for SPs [m].
        floor: share that always remains.
    """
    least, total = math.log(floor), 0.0
    if kind != SP:
        total = undetected.looks * math.log1p(-min(probability, LARGEST_PROBABILITY))
    else:
        viewpoints = undetected.viewpoints
        for k in range(len(viewpoints)):
            away = apart(viewpoints[k, 0], viewpoints[k, 1], ue_height, position)
            seen = detection_probability(kind, away, spread, probability, view)
            total += undetected.viewpoint_looks[k] * math.log1p(-min(seen, LARGEST_PROBABILITY))
    return max(total, least)


@part
def apart(x: float, y: float, z: float, position: FloatArray) -> float:
    """Distance of a point from position (3,) [m]."""
    dx, dy, dz = position[0] - x, position[1] - y, position[2] - z
    return math.sqrt(dx * dx + dy * dy + dz * dz)


@compiled
def looked_from(undetected: Undetected, x: float, y: float, view: float) -> Undetected:
    """After one more snapshot, taken from (x, y) [m]."""
    viewpoints, viewpoint_looks = undetected.viewpoints, undetected.viewpoint_looks
    count = len(viewpoints)
    nearest, least, most = 0, math.inf, 0.0
    away = np.empty(count)
    for k in range(count):
        away[k] = math.hypot(viewpoints[k, 0] - x, viewpoints[k, 1] - y)
        if away[k] < least:
            nearest, least = k, away[k]
        most = max(most, away[k])
    if least < SPACING * view:
        looks = viewpoint_looks.copy()
        looks[nearest] += 1
        return Undetected(undetected.looks + 1, viewpoints, looks)
    # What is beyond two fields of view cannot overlap with this one.
    limit = math.inf
    if most > 2.0 * view or count > MOST_VIEWPOINTS:
        limit = 2.0 * view
    kept, first = 0, count
    while first > 0 and kept < MOST_VIEWPOINTS:
        first -= 1
        kept += away[first] <= limit
    more, looks, filled = np.empty((kept + 1, 2)), np.empty(kept + 1, np.int64), 0
    for k in range(first, count):
        if away[k] <= limit:
            more[filled, 0], more[filled, 1] = viewpoints[k, 0], viewpoints[k, 1]
            looks[filled] = viewpoint_looks[k]
            filled += 1
    more[filled, 0], more[filled, 1], looks[filled] = x, y, 1
    return Undetected(undetected.looks + 1, more, looks)
