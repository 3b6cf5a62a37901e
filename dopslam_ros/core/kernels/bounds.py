"""The information that a set of paths carries."""

from __future__ import annotations

import numpy as np

from dopslam_ros.core.arrays import BoolArray, FloatArray, IntArray
from dopslam_ros.core.kernels.compiled import compiled
from dopslam_ros.core.kernels.small import cholesky, forward, used_places

DIM, UE = 6, 4


@compiled
def gather(
    a: FloatArray,
    b: FloatArray,
    used: BoolArray,
    noise: FloatArray,
    weights: FloatArray,
    start: IntArray,
    data: FloatArray,
) -> bool:
    """Adds w H' R^-1 H of every path to the information ``data``.

    Args:
        a: (M, 6, 4) Jacobians by the vehicle.
        b: (M, 6, 3) by the landmarks.
        used: (M, 6) components that each path has.
        noise: (M, 6, 6) R.
        weights: (M,) w; nothing is added where it is zero.
        start: (M,) index of the landmark's block, -1 for one that has none.
        data: (n, n), the vehicle first.

    Returns:
        Whether every R was positive definite over what was measured.
    """
    place = np.empty(DIM, np.int64)
    factor = np.empty((DIM, DIM))
    columns = np.empty((UE + 3, DIM))
    index = np.empty(UE + 3, np.int64)
    for m in range(len(weights)):
        if not weights[m] > 0.0:
            continue
        count = used_places(used[m], place)
        for k in range(count):
            for i in range(k + 1):
                factor[k, i] = noise[m, place[k], place[i]]
        if not cholesky(factor, count):
            return False
        width = UE if start[m] < 0 else UE + 3
        for j in range(width):
            index[j] = j if j < UE else start[m] + j - UE
            for k in range(count):
                columns[j, k] = a[m, place[k], j] if j < UE else b[m, place[k], j - UE]
            forward(factor, columns[j], count)
        for i in range(width):
            for j in range(width):
                total = 0.0
                for k in range(count):
                    total += columns[i, k] * columns[j, k]
                data[index[i], index[j]] += weights[m] * total
    return True
