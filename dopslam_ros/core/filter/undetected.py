"""Where landmarks that were never detected may still be: the Poisson part of the density.

Their intensity is uniform at first. Each snapshot thins it out by 1 - p_D where a detection was
possible: for VAs everywhere, for SPs in the field of view only. So the filter remembers from where
it looked. A path from a place that it has looked at ten times is clutter; the same path from the
edge of what it has seen is a new landmark.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dopslam_ros.core.arrays import FloatArray, IntArray, check_shapes, floats, integers
from dopslam_ros.core.kernels import detection as kernels
from dopslam_ros.core.model import ModelParameters

# Viewpoints nearer to each other than this share of the field of view count as one.
SPACING = 0.1
# More than any field of view needs; the oldest go first.
MOST_VIEWPOINTS = 400
_ONE = np.ones(1, dtype=np.int64)


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
    log_share = np.empty(len(types))
    check_shapes(positions=(positions, (len(types), 3)), spread=(spread, log_share.shape))
    kernels.log_shares_left(
        int(undetected.looks),
        floats(undetected.viewpoints),
        integers(undetected.viewpoint_looks),
        float(model.ue_height),
        floats(positions),
        integers(types),
        floats(spread),
        float(model.detection_probability),
        float(model.sp_field_of_view),
        float(floor),
        log_share,
    )
    return log_share


def looked_from(undetected: Undetected, ue: FloatArray, model: ModelParameters) -> Undetected:
    """One more snapshot, taken from ``ue`` (2,) [m]."""
    view = model.sp_field_of_view
    viewpoints, looks = undetected.viewpoints, undetected.viewpoint_looks
    nearest, distance, farthest = kernels.nearest_viewpoint(viewpoints, ue[0], ue[1])
    if distance < SPACING * view:
        looks = looks.copy()
        looks[nearest] += 1
        return Undetected(undetected.looks + 1, viewpoints, looks)
    if farthest > 2.0 * view or len(looks) > MOST_VIEWPOINTS:
        # What is beyond two fields of view cannot overlap with this one.
        away = np.linalg.norm(viewpoints - ue, axis=1)
        near = np.flatnonzero(away <= 2.0 * view)[-MOST_VIEWPOINTS:]
        viewpoints, looks = viewpoints[near], looks[near]
    return Undetected(
        undetected.looks + 1,
        np.concatenate((viewpoints, ue[None])),
        np.concatenate((looks, _ONE)),
    )
