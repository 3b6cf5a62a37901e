"""The recursion of the bounds: the information that a set of paths brings."""

from __future__ import annotations

import math

import numpy as np

from dopslam_ros.core.linalg.arrays import BoolArray, FloatArray, IntArray
from dopslam_ros.core.linalg.jit import from_python, jit
from dopslam_ros.core.linalg.small import cholesky, forward_columns
from dopslam_ros.core.settings.layout import CLOCK_BIAS, HEADING, SPACE, X, Y

# Standard deviation of a landmark before its first path [m]: no information, but invertible.
DIFFUSE_STD = 1e4
# A landmark whose bound is larger than this [m] is one that the measurements cannot locate.
UNLOCATED = 0.1 * DIFFUSE_STD


@from_python
def update(
    covariance: FloatArray,
    known: IntArray,
    a: FloatArray,
    b: FloatArray,
    degenerate: BoolArray,
    ids: IntArray,
    is_bs: BoolArray,
    weights: FloatArray,
    noise: FloatArray,
    used: BoolArray,
) -> tuple[FloatArray, IntArray, bool]:
    """``inform`` where landmarks are told by their ids, and those seen first are appended.

    Args:
        covariance: (n, n) P, the vehicle first.
        known: (L,) ids of the landmarks in it, in the order of their blocks.
        a: (M, 6, U) Jacobians by the vehicle.
        b: (M, 6, 3) by the landmarks.
        degenerate: (M,) paths without an answer, which bring nothing.
        ids: (M,) of the landmarks.
        is_bs: (M,) the landmark has no block.
        weights: (M,) share of the information that counts.
        noise: (1 or M, 6, 6) R, of all or of each.
        used: (1 or M, 6) components, of all or of each.

    Returns:
        Covariance and ids after it, and whether what was to be inverted was positive definite.
    """
    count, filled, vehicle, size = len(ids), len(known), a.shape[2], b.shape[2]
    blocks = np.empty(filled + count, np.int64)
    blocks[:filled] = known
    counted, start = np.zeros(count), np.full(count, -1)
    for m in range(count):
        if degenerate[m] or not weights[m] > 0.0:
            continue
        counted[m] = weights[m]
        if not is_bs[m]:
            place = place_of(blocks, filled, ids[m])
            if place == filled:
                blocks[filled] = ids[m]
                filled += 1
            start[m] = vehicle + size * place
    if not counted.any():
        return covariance, known, True
    old = len(covariance)
    grown = np.zeros((vehicle + size * filled, vehicle + size * filled))
    grown[:old, :old] = covariance
    for i in range(old, len(grown)):
        grown[i, i] = DIFFUSE_STD**2
    after, sound = inform(grown, a, b, used, noise, counted, start)
    return after, blocks[:filled].copy(), sound


@from_python
def read_bounds(
    covariance: FloatArray, known: IntArray, ids: IntArray, leb: FloatArray
) -> tuple[float, float, float]:
    """PEB, HEB and CEB of a covariance (n, n); writes LEB of landmarks (M,) into leb (M,).

    Infinity for one that is not among those known (L,), or is not located.
    """
    vehicle = len(covariance) - SPACE * len(known)
    for m in range(len(ids)):
        place, leb[m] = place_of(known, len(known), ids[m]), math.inf
        if place < len(known):
            at = vehicle + SPACE * place
            variance = covariance[at, at] + covariance[at + 1, at + 1]
            bound = math.sqrt(variance + covariance[at + 2, at + 2])
            if bound < UNLOCATED:
                leb[m] = bound
    peb = math.sqrt(covariance[X, X] + covariance[Y, Y])
    heb, ceb = covariance[HEADING, HEADING], covariance[CLOCK_BIAS, CLOCK_BIAS]
    return peb, math.sqrt(heb), math.sqrt(ceb)


@jit
def place_of(ids: IntArray, count: int, wanted: int) -> int:
    """Where an id is among the first of ids; count if it is not."""
    for place in range(count):
        if ids[place] == wanted:
            return place
    return count


@jit
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
        a: (M, 6, U) Jacobians by the vehicle.
        b: (M, 6, 3) by the landmarks.
        used: (1 or M, 6) components that the paths have.
        noise: (1 or M, 6, 6) R.
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
            sound = whiten(m, a, b, used, noise, weights[m], start[m], root, rows) and sound
            add_products(rows, n, inner)
    sound = factorise(inner) and sound
    # X = C^-1 L', of which only the upper triangle is not zero.
    x = np.empty((n, n))
    for i in range(n):
        for j in range(n):
            x[i, j] = root[j, i] if j >= i else 0.0
    for i in range(n):
        for k in range(i):
            factor = inner[i, k]
            for j in range(n):
                x[i, j] -= factor * x[k, j]
        scale = 1.0 / inner[i, i]
        for j in range(n):
            x[i, j] *= scale
    after = np.zeros((n, n))
    add_products(x, n, after)
    for i in range(n):
        for j in range(i):
            after[j, i] = after[i, j]
    return after, sound


@jit
def whiten(
    m: int,
    a: FloatArray,
    b: FloatArray,
    used: BoolArray,
    noise: FloatArray,
    weight: float,
    start: int,
    root: FloatArray,
    rows: FloatArray,
) -> bool:
    """Writes sqrt(w) R^-1/2 H L of path m into rows (6, n), zero where it has no component.

    H is the block row [A ... B ...] of eq. (18).
    """
    dim, n = rows.shape
    factor = np.empty((dim, dim))
    mask, r, scale = m % len(used), m % len(noise), math.sqrt(weight)
    for k in range(dim):
        for j in range(n):
            rows[k, j] = 0.0
        for i in range(k + 1):
            factor[k, i] = 1.0 if i == k else 0.0
            if used[mask, k] and used[mask, i]:
                factor[k, i] = noise[r, k, i]
        if not used[mask, k]:
            continue
        for i in range(a.shape[2]):
            # L is lower triangular.
            by = scale * a[m, k, i]
            for j in range(i + 1):
                rows[k, j] += by * root[i, j]
        if start >= 0:
            for i in range(b.shape[2]):
                by = scale * b[m, k, i]
                for j in range(start + i + 1):
                    rows[k, j] += by * root[start + i, j]
    sound = cholesky(factor, len(factor))
    forward_columns(factor, rows, len(factor))
    return sound


@jit
def add_products(rows: FloatArray, n: int, total: FloatArray) -> None:
    """Adds rows' rows, rows (m, n), to the lower triangle of total (n, n)."""
    for k in range(len(rows)):
        for i in range(n):
            factor = rows[k, i]
            if factor != 0.0:
                for j in range(i + 1):
                    total[i, j] += factor * rows[k, j]


@jit
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
            factor = column[i]
            for j in range(k + 1, i + 1):
                matrix[i, j] -= factor * column[j]
    return True
