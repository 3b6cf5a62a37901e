"""The information that a set of paths brings."""

from __future__ import annotations

import math

import numpy as np

from dopslam_ros.core.arrays import BoolArray, FloatArray, IntArray
from dopslam_ros.core.kernels.compiled import compiled, part
from dopslam_ros.core.kernels.records import UE
from dopslam_ros.core.kernels.small import cholesky, forward_columns


@compiled
def inform(
    covariance: FloatArray,
    a: FloatArray,
    b: FloatArray,
    used: BoolArray,
    noise: FloatArray,
    weights: FloatArray,
    start: IntArray,
) -> tuple[FloatArray, bool]:
    """(P^-1 + sum of w H' R^-1 H over the paths)^-1, so that nothing tiny is inverted.

    With P = L L' it is L (I + L' data L)^-1 L': the matrix that is solved has no eigenvalue below
    one, however diffuse a landmark is.

    Args:
        covariance: (n, n) P, the vehicle first.
        a: (M, 6, 4) Jacobians by the vehicle.
        b: (M, 6, 3) by the landmarks.
        used: (M, 6) components that each path has.
        noise: (M, 6, 6) R.
        weights: (M,) w; a path whose weight is zero brings nothing.
        start: (M,) index of the landmark's block, -1 for one that has none.

    Returns:
        (n, n), and whether P and every R over what was measured were positive definite.
    """
    n = len(covariance)
    root = covariance.copy()
    sound = factorise(root)
    inner = np.eye(n)
    rows = np.empty((a.shape[1], n))
    for m in range(len(weights)):
        if weights[m] > 0.0:
            sound = (
                whiten(a[m], b[m], used[m], noise[m], weights[m], start[m], root, rows) and sound
            )
            add_products(rows, n, inner)
    sound = factorise(inner) and sound
    # X = C^-1 L', of which only the upper triangle is not zero.
    x = np.empty((n, n))
    for i in range(n):
        for j in range(n):
            x[i, j] = root[j, i] if j >= i else 0.0
    for i in range(n):
        row = x[i]
        for k in range(i):
            factor, other = inner[i, k], x[k]
            for j in range(n):
                row[j] -= factor * other[j]
        scale = 1.0 / inner[i, i]
        for j in range(n):
            row[j] *= scale
    after = np.zeros((n, n))
    add_products(x, n, after)
    for i in range(n):
        for j in range(i):
            after[j, i] = after[i, j]
    return after, sound


@part
def whiten(
    a: FloatArray,
    b: FloatArray,
    used: BoolArray,
    noise: FloatArray,
    weight: float,
    start: int,
    root: FloatArray,
    rows: FloatArray,
) -> bool:
    """Writes sqrt(w) R^-1/2 H L of one path into rows (6, n), zero where it has no component."""
    dim, n = rows.shape
    factor = np.empty((dim, dim))
    for k in range(dim):
        row = rows[k]
        for j in range(n):
            row[j] = 0.0
        for i in range(k + 1):
            factor[k, i] = 1.0 if i == k else 0.0
            if used[k] and used[i]:
                factor[k, i] = noise[k, i]
        if not used[k]:
            continue
        scale = math.sqrt(weight)
        for i in range(UE):
            # L is lower triangular.
            for j in range(i + 1):
                row[j] += scale * a[k, i] * root[i, j]
        if start >= 0:
            for i in range(3):
                by, other = scale * b[k, i], root[start + i]
                for j in range(start + i + 1):
                    row[j] += by * other[j]
    sound = cholesky(factor, len(factor))
    forward_columns(factor, rows, len(factor))
    return sound


@part
def add_products(rows: FloatArray, n: int, total: FloatArray) -> None:
    """Adds rows' rows, rows (m, n), to the lower triangle of total (n, n)."""
    for row in rows:
        for i in range(n):
            factor, into = row[i], total[i]
            if factor != 0.0:
                for j in range(i + 1):
                    into[j] += factor * row[j]


@part
def factorise(matrix: FloatArray) -> bool:
    """Replaces the lower triangle of (n, n) by its Cholesky factor, column by column.

    For larger matrices than those of ``small``: the inner loops run along rows.
    """
    n = len(matrix)
    column = np.empty(n)
    for k in range(n):
        if not matrix[k, k] > 0.0:
            return False
        scale = 1.0 / math.sqrt(matrix[k, k])
        for i in range(k, n):
            matrix[i, k] *= scale
            column[i] = matrix[i, k]
        for i in range(k + 1, n):
            factor, row = column[i], matrix[i]
            for j in range(k + 1, i + 1):
                row[j] -= factor * column[j]
    return True
