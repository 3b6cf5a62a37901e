"""Where landmarks that were never detected may still be: the Poisson part of the density.

Their intensity is uniform at first. Each snapshot thins it out by 1 - p_D where a detection was
possible: for VAs everywhere, for SPs in the field of view only. So the filter remembers from where
it looked. A path from a place that it has looked at ten times is clutter; the same path from the
edge of what it has seen is a new landmark.
"""

from __future__ import annotations

import math

import numpy as np

from dopslam_ros.core.linalg.arrays import BoolArray, FloatArray
from dopslam_ros.core.linalg.jit import from_python, jit
from dopslam_ros.core.linalg.vec import Vec, distance_between
from dopslam_ros.core.models.detection import detection_probability
from dopslam_ros.core.pmb.density import Undetected
from dopslam_ros.core.settings.filtering import Constants
from dopslam_ros.core.settings.layout import SP, X, Y

# Even what is always detected leaves a chance to have been missed.
LARGEST_PROBABILITY = 1.0 - 1e-9
# Viewpoints nearer to each other than this share of the field of view count as one.
SPACING = 0.1
# More than any field of view needs; the oldest go first.
MOST_VIEWPOINTS = 400


def nothing_seen() -> Undetected:
    """Before the first snapshot."""
    return Undetected(0, np.zeros((0, 2)), np.zeros(0, dtype=np.int64))


@jit
def log_share_left(
    undetected: Undetected, position: Vec, kind: int, distance_std: float, constants: Constants
) -> float:
    """ln of the product of 1 - p_D over all snapshots: the share of landmarks left undetected.

    Args:
        undetected: from where how often nothing new was detected.
        position: where they are [m].
        kind: VA or SP.
        distance_std: standard deviation of their distance from the vehicle [m].
        constants: p_D, the field of view, and the share that always remains.
    """
    p_d, log_share = constants.detection_probability, 0.0
    if kind != SP:
        log_share = undetected.looks * math.log1p(-min(p_d, LARGEST_PROBABILITY))
    else:
        viewpoints = undetected.viewpoints
        for k in range(len(viewpoints)):
            viewpoint = Vec(viewpoints[k, X], viewpoints[k, Y], constants.ue_height)
            distance = distance_between(viewpoint, position)
            seen = detection_probability(
                kind, distance, distance_std, p_d, constants.sp_field_of_view
            )
            looks = undetected.viewpoint_looks[k]
            log_share += looks * math.log1p(-min(seen, LARGEST_PROBABILITY))
    return max(log_share, math.log(constants.undetected_floor))


@from_python
def looked_from(undetected: Undetected, x: float, y: float, sp_field_of_view: float) -> Undetected:
    """After one more snapshot, taken from (x, y) [m], with a field of view for SPs [m]."""
    distance = distances(undetected.viewpoints, x, y)
    nearest = 0
    for k in range(len(distance)):
        if distance[k] < distance[nearest]:
            nearest = k
    if len(distance) > 0 and distance[nearest] < SPACING * sp_field_of_view:
        looks = undetected.viewpoint_looks.copy()
        looks[nearest] += 1
        return Undetected(undetected.looks + 1, undetected.viewpoints, looks)
    # What is beyond two fields of view cannot overlap with this one.
    return with_viewpoint(undetected, x, y, distance <= 2.0 * sp_field_of_view)


@jit
def distances(viewpoints: FloatArray, x: float, y: float) -> FloatArray:
    """(K,) of viewpoints (K, 2) from (x, y) [m]."""
    distance = np.empty(len(viewpoints))
    for k in range(len(viewpoints)):
        distance[k] = math.hypot(viewpoints[k, X] - x, viewpoints[k, Y] - y)
    return distance


@jit
def with_viewpoint(undetected: Undetected, x: float, y: float, kept: BoolArray) -> Undetected:
    """With (x, y) [m] as a new viewpoint behind those that are kept (K,), the newest of them."""
    first, count = len(kept), 0
    while first > 0 and count < MOST_VIEWPOINTS:
        first -= 1
        count += kept[first]
    viewpoints, looks = np.empty((count + 1, 2)), np.empty(count + 1, np.int64)
    filled = 0
    for k in range(first, len(kept)):
        if kept[k]:
            viewpoints[filled, X] = undetected.viewpoints[k, X]
            viewpoints[filled, Y] = undetected.viewpoints[k, Y]
            looks[filled] = undetected.viewpoint_looks[k]
            filled += 1
    viewpoints[count, X], viewpoints[count, Y], looks[count] = x, y, 1
    return Undetected(undetected.looks + 1, viewpoints, looks)
