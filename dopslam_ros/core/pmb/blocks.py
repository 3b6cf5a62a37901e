"""Where the blocks of vehicle and landmarks are in the joint vector [s; q_1 ... q_C]."""

from __future__ import annotations

import numpy as np

from dopslam_ros.core.linalg.arrays import IntArray
from dopslam_ros.core.linalg.jit import from_python
from dopslam_ros.core.settings.layout import LANDMARK_SIZES


@from_python
def block_starts(vehicle: int, types: IntArray) -> IntArray:
    """(C + 1,) where the block of each component begins; the last entry is the size of the vector.

    Args:
        vehicle: how many numbers the vehicle has; its block is the first one.
        types: (C,) LandmarkType of the components, which says how many numbers each has.
    """
    start = np.empty(len(types) + 1, np.int64)
    start[0] = vehicle
    for c in range(len(types)):
        start[c + 1] = start[c] + LANDMARK_SIZES[types[c]]
    return start
