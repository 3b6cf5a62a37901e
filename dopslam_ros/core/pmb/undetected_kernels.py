"""Landmarks never detected: what is left of their intensity, and from where the filter looked."""

from __future__ import annotations

import math

import numpy as np

from dopslam_ros.core.linalg.arrays import FloatArray
from dopslam_ros.core.linalg.jit import from_python, jit
from dopslam_ros.core.models.detection_kernels import detection_probability, distance_between
from dopslam_ros.core.pmb.density import Undetected
from dopslam_ros.core.settings.layout import SP

# Even what is always detected leaves a chance to have been missed.
LARGEST_PROBABILITY = 1.0 - 1e-9


# Viewpoints nearer to each other than this share of the field of view count as one.
SPACING = 0.1


# More than any field of view needs; the oldest go first.
MOST_VIEWPOINTS = 400


@jit
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
            away = distance_between(viewpoints[k, 0], viewpoints[k, 1], ue_height, position)
            seen = detection_probability(kind, away, spread, probability, view)
            total += undetected.viewpoint_looks[k] * math.log1p(-min(seen, LARGEST_PROBABILITY))
    return max(total, least)


@from_python
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
