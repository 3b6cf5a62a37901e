"""Where landmarks that were never detected may still be: the Poisson part of the density.

Their intensity is uniform at first. Each snapshot thins it out by 1 - p_D where a detection was
possible: for VAs everywhere, for SPs in the field of view only. So the filter remembers from where
it looked. A path from a place that it has looked at ten times is clutter; the same path from the
edge of what it has seen is a new landmark.
"""

from __future__ import annotations

import numpy as np

from dopslam_ros.core.linalg.arrays import FloatArray
from dopslam_ros.core.pmb import undetected_kernels as kernels
from dopslam_ros.core.pmb.density import Undetected
from dopslam_ros.core.settings.model import ModelParameters


def nothing_seen() -> Undetected:
    """Before the first snapshot."""
    return Undetected(0, np.zeros((0, 2)), np.zeros(0, dtype=np.int64))


def looked_from(undetected: Undetected, ue: FloatArray, model: ModelParameters) -> Undetected:
    """One more snapshot, taken from ``ue`` (2,) [m]."""
    return kernels.looked_from(
        undetected, float(ue[0]), float(ue[1]), float(model.sp_field_of_view)
    )
