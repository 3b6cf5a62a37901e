"""Where landmarks that were never detected may still be: the Poisson part of the density.

Their intensity is uniform at first. Each snapshot thins it out by 1 - p_D where a detection was
possible: for VAs everywhere, for SPs in the field of view only. So the filter remembers from where
it looked. A path from a place that it has looked at ten times is clutter; the same path from the
edge of what it has seen is a new landmark.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dopslam_ros.core.arrays import FloatArray, IntArray
from dopslam_ros.core.channel import LandmarkType
from dopslam_ros.core.model import ModelParameters, detection_probabilities

# Viewpoints nearer to each other than this share of the field of view count as one.
SPACING = 0.1
# More than any field of view needs; the oldest go first.
MOST_VIEWPOINTS = 400


@dataclass(frozen=True)
class Undetected:
    """From where how often nothing new was detected.

    Attributes:
        looks: number of snapshots so far.
        viewpoints: (K, 2) places of the vehicle [m], those whose field of view still matters.
        viewpoint_looks: (K,) number of snapshots near each.
    """

    looks: int
    viewpoints: FloatArray
    viewpoint_looks: IntArray


def nothing_seen() -> Undetected:
    """Before the first snapshot."""
    return Undetected(0, np.zeros((0, 2)), np.zeros(0, dtype=np.int64))


def log_share_left(
    undetected: Undetected,
    positions: FloatArray,
    types: IntArray,
    spread: FloatArray,
    model: ModelParameters,
    floor: float,
) -> FloatArray:
    """ln of the share of the intensity that is left at some places.

    Args:
        undetected: what was looked at.
        positions: (M, 3) places [m].
        types: (M,) VA or SP.
        spread: (M,) standard deviation of their distances from the vehicle [m].
        model: p_D and the field of view.
        floor: share that always remains.

    Returns:
        (M,).
    """
    p_d = model.detection_probability
    log_share = np.full(len(positions), undetected.looks * np.log1p(-min(p_d, 1.0 - 1e-9)))
    scattered = np.flatnonzero(types == LandmarkType.SP)
    log_share[scattered] = 0.0
    for place, looks in zip(undetected.viewpoints, undetected.viewpoint_looks, strict=True):
        ue = np.append(place, model.ue_height)
        seen = detection_probabilities(
            model, ue, positions[scattered], types[scattered], spread[scattered]
        )
        log_share[scattered] += looks * np.log1p(-np.minimum(seen, 1.0 - 1e-9))
    return np.asarray(np.maximum(log_share, np.log(floor)))


def looked_from(undetected: Undetected, ue: FloatArray, model: ModelParameters) -> Undetected:
    """One more snapshot, taken from ``ue`` (2,) [m]."""
    view = model.sp_field_of_view
    away = np.linalg.norm(undetected.viewpoints - ue, axis=1)
    # What is beyond two fields of view cannot overlap with this one.
    near = np.flatnonzero(away <= 2.0 * view)[-MOST_VIEWPOINTS:]
    viewpoints, looks = undetected.viewpoints[near], undetected.viewpoint_looks[near]
    if len(near) and away[near].min() < SPACING * view:
        looks = looks + (np.arange(len(near)) == np.argmin(away[near]))
    else:
        viewpoints, looks = np.vstack([viewpoints, ue]), np.append(looks, 1)
    return replace(
        undetected, looks=undetected.looks + 1, viewpoints=viewpoints, viewpoint_looks=looks
    )
