"""Linear algebra of small matrices without calls or copies."""

from __future__ import annotations

import math

import numpy as np

from dopslam_ros.core.linalg.arrays import BoolArray, FloatArray, IntArray
from dopslam_ros.core.linalg.jit import jit


@jit
def cholesky(a: FloatArray, n: int) -> bool:
    """Replaces the lower triangle of a (n, n) by its Cholesky factor L; a = L L'.

    Only the lower triangle is read; the upper one stays as it is.

    Returns:
        Whether a is positive definite; otherwise its content is of no use any more.
    """
    for j in range(n):
        pivot = a[j, j]
        for k in range(j):
            pivot -= a[j, k] * a[j, k]
        if not pivot > 0.0:
            return False
        root = math.sqrt(pivot)
        a[j, j] = root
        for i in range(j + 1, n):
            entry = a[i, j]
            for k in range(j):
                entry -= a[i, k] * a[j, k]
            a[i, j] = entry / root
    return True


@jit
def forward(lower: FloatArray, x: FloatArray, n: int) -> None:
    """Replaces x (n,) by the solution y of L y = x."""
    for i in range(n):
        entry = x[i]
        for k in range(i):
            entry -= lower[i, k] * x[k]
        x[i] = entry / lower[i, i]


@jit
def forward_columns(lower: FloatArray, x: FloatArray, n: int) -> None:
    """Replaces x (n, m) by the solution Y of L Y = X."""
    columns = x.shape[1]
    for i in range(n):
        for k in range(i):
            factor = lower[i, k]
            for c in range(columns):
                x[i, c] -= factor * x[k, c]
        scale = 1.0 / lower[i, i]
        for c in range(columns):
            x[i, c] *= scale


@jit
def backward(lower: FloatArray, x: FloatArray, n: int) -> None:
    """Replaces x (n,) by the solution y of L' y = x."""
    for i in range(n - 1, -1, -1):
        entry = x[i]
        for k in range(i + 1, n):
            entry -= lower[k, i] * x[k]
        x[i] = entry / lower[i, i]


@jit
def solve_bordered(a: FloatArray, n: int) -> float:
    """Solves L L' x = y, L the lower triangle of a (n + 1, n + 1), y its last row, which becomes x.

    Returns:
        The squared length of L^-1 y.
    """
    size = 0.0
    for i in range(n):
        entry = a[n, i]
        for k in range(i):
            entry -= a[i, k] * a[n, k]
        a[n, i] = entry / a[i, i]
        size += a[n, i] * a[n, i]
    for i in range(n - 1, -1, -1):
        entry = a[n, i]
        for k in range(i + 1, n):
            entry -= a[k, i] * a[n, k]
        a[n, i] = entry / a[i, i]
    return size


@jit
def log_determinant(lower: FloatArray, n: int) -> float:
    """ln det(L L')."""
    total = 0.0
    for i in range(n):
        total += math.log(lower[i, i])
    return 2.0 * total


@jit
def used_indices(used: BoolArray, indices: IntArray) -> int:
    """Writes where used (n,) holds to the front of indices (n,); returns how many there are."""
    count = 0
    for index in range(len(used)):
        if used[index]:
            indices[count] = index
            count += 1
    return count


@jit
def solve(lower: FloatArray, x: FloatArray, n: int) -> None:
    """Replaces x (n,) by the solution y of L L' y = x."""
    forward(lower, x, n)
    backward(lower, x, n)


@jit
def invert(lower: FloatArray, n: int, inverse: FloatArray) -> None:
    """Writes the inverse (n, n) of L L', column by column: symmetric but for rounding."""
    column = np.empty(n)
    for i in range(n):
        column.fill(0.0)
        column[i] = 1.0
        solve(lower, column, n)
        for k in range(n):
            inverse[k, i] = column[k]
