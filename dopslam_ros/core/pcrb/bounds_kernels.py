"""The recursion of the bounds: the information that a set of paths brings."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dopslam_ros.core.linalg.arrays import BoolArray, FloatArray, IntArray
from dopslam_ros.core.linalg.jit import from_python, jit, jit_inline
from dopslam_ros.core.linalg.small import cholesky, forward_columns
from dopslam_ros.core.settings.layout import (
    CLOCK_BIAS,
    HEADING,
    LANDMARK_SIZES,
    NONE,
    SPACE,
    X,
    Y,
)

# Standard deviation of a landmark before its first path [m]: no information, but invertible.
DIFFUSE_STD = 1e4
# A landmark whose bound is larger than this [m] is one that the measurements cannot locate.
UNLOCATED = 0.1 * DIFFUSE_STD


class BoundState(NamedTuple):
    """What the recursion carries from one snapshot to the next.

    Attributes:
        covariance: (n, n) inverse of the PIM, J^-1, over [s; x of the landmarks seen].
        ids: (L,) the landmarks in it, in the order of their blocks.
        start: (L + 1,) where the block of each begins; the vehicle's is before the first one, the
            last entry is n.
    """

    covariance: FloatArray
    ids: IntArray
    start: IntArray


class PathInformation(NamedTuple):
    """What is known of M paths, of each or of all alike.

    Attributes:
        ue_jacobian: (M, 6, U) A = dh/ds.
        landmark_jacobian: (M, 6, 3) B = dh/dx.
        weight: (M,) share of the information that counts; 0 for what has no path.
        noise: (1 or M, 6, 6) R.
        used: (1 or M, 6) components that the paths have.
    """

    ue_jacobian: FloatArray
    landmark_jacobian: FloatArray
    weight: FloatArray
    noise: FloatArray
    used: BoolArray


@from_python
def update(
    covariance: FloatArray,
    known: IntArray,
    start: IntArray,
    paths: PathInformation,
    ids: IntArray,
    types: IntArray,
) -> tuple[FloatArray, IntArray, IntArray, bool]:
    """J = J_data + J_prior of eq. (17), where landmarks seen first get a block of their own.

    Args:
        covariance: (n, n) of the predicted ``BoundState``, handed over in its parts: a record
            costs as much to take in from Python as a tenth of the update.
        known: (L,) its ids.
        start: (L + 1,) of its blocks.
        paths: one of each landmark.
        ids: (M,) of the landmarks.
        types: (M,) LandmarkType, which says how large their blocks are; a BS has none.

    Returns:
        The parts of the state after it, and whether what was to be inverted was positive definite.
    """
    if not (paths.weight > 0.0).any():
        return covariance, known, start, True
    state, block = with_blocks(BoundState(covariance, known, start), paths.weight, ids, types)
    after, sound = add_information(state.covariance, paths, block)
    return after, state.ids, state.start, sound


@jit
def with_blocks(
    state: BoundState, weight: FloatArray, ids: IntArray, types: IntArray
) -> tuple[BoundState, IntArray]:
    """With a diffuse block for each landmark that is seen for the first time.

    Args:
        state: before.
        weight: (M,) 0 for landmarks that are not seen.
        ids: (M,) of the landmarks.
        types: (M,) LandmarkType.

    Returns:
        The state, and (M,) the index at which the block of each landmark begins; NONE without one.
    """
    known, most = len(state.ids), len(state.ids) + len(ids)
    all_ids, start = np.empty(most, np.int64), np.empty(most + 1, np.int64)
    for k in range(known):
        all_ids[k] = state.ids[k]
    for k in range(known + 1):
        start[k] = state.start[k]
    block = np.full(len(ids), NONE)
    for m in range(len(ids)):
        size = LANDMARK_SIZES[types[m]]
        if not weight[m] > 0.0 or size == 0:
            continue
        k = index_of(all_ids, known, ids[m])
        if k == known:
            all_ids[k], start[k + 1] = ids[m], start[k] + size
            known += 1
        block[m] = start[k]
    old, total = len(state.covariance), start[known]
    covariance = np.zeros((total, total))
    covariance[:old, :old] = state.covariance
    for i in range(old, total):
        covariance[i, i] = DIFFUSE_STD**2
    return BoundState(covariance, all_ids[:known].copy(), start[: known + 1].copy()), block


@from_python
def read_bounds(
    covariance: FloatArray, known: IntArray, start: IntArray, ids: IntArray
) -> tuple[float, float, float, FloatArray]:
    """PEB, HEB, CEB, and (M,) LEB of landmarks (M,), from the parts of a ``BoundState``.

    Infinity for one that is not among those seen, or is not located.
    """
    leb = np.full(len(ids), math.inf)
    for m in range(len(ids)):
        k = index_of(known, len(known), ids[m])
        if k < len(known):
            variance, first = 0.0, start[k]
            for i in range(first, first + SPACE):
                variance += covariance[i, i]
            bound = math.sqrt(variance)
            if bound < UNLOCATED:
                leb[m] = bound
    peb = math.sqrt(covariance[X, X] + covariance[Y, Y])
    heb, ceb = covariance[HEADING, HEADING], covariance[CLOCK_BIAS, CLOCK_BIAS]
    return peb, math.sqrt(heb), math.sqrt(ceb), leb


@jit
def index_of(ids: IntArray, count: int, wanted: int) -> int:
    """Where an id is among the first of ids; count if it is not."""
    for k in range(count):
        if ids[k] == wanted:
            return k
    return count


@jit
def add_information(
    covariance: FloatArray, paths: PathInformation, block: IntArray
) -> tuple[FloatArray, bool]:
    """(P^-1 + sum of w H' R^-1 H over the paths)^-1, so that nothing tiny is inverted.

    With P = L L' it is L (I + L' data L)^-1 L': the matrix that is solved has no eigenvalue below
    one, however diffuse a landmark is.

    Args:
        covariance: (n, n) P, the vehicle first.
        paths: with H = [A ... B ...].
        block: (M,) index of the landmark's block, NONE for one that has none.

    Returns:
        (n, n), and whether P and every R over what was measured were positive definite.
    """
    n = len(covariance)
    root = covariance.copy()
    sound = factorise(root)
    inner, rows = np.eye(n), np.empty((paths.ue_jacobian.shape[1], n))
    for m in range(len(block)):
        if paths.weight[m] > 0.0:
            sound = whiten(paths, m, block[m], root, rows) and sound
            add_products(rows, n, inner)
    sound = factorise(inner) and sound
    # X = C^-1 L', of which only the upper triangle is not zero.
    x = np.empty((n, n))
    for i in range(n):
        for j in range(n):
            x[i, j] = root[j, i] if j >= i else 0.0
    forward_columns(inner, x, n)
    after = np.zeros((n, n))
    add_products(x, n, after)
    for i in range(n):
        for j in range(i):
            after[j, i] = after[i, j]
    return after, sound


@jit_inline
def whiten(paths: PathInformation, m: int, block: int, root: FloatArray, rows: FloatArray) -> bool:
    """Writes sqrt(w) R^-1/2 H L of path m into rows (6, n), zero where it has no component.

    H is the block row [A ... B ...] of eq. (18).

    Args:
        paths: with A, B, R and w.
        m: the path.
        block: index of its landmark's block, NONE without one.
        root: (n, n) L, lower triangular.
        rows: result.

    Returns:
        Whether R over what was measured is positive definite.
    """
    dim, n = rows.shape
    mask, r, scale = m % len(paths.used), m % len(paths.noise), math.sqrt(paths.weight[m])
    factor = np.empty((dim, dim))
    for k in range(dim):
        for j in range(n):
            rows[k, j] = 0.0
        for i in range(k + 1):
            factor[k, i] = 1.0 if i == k else 0.0
            if paths.used[mask, k] and paths.used[mask, i]:
                factor[k, i] = paths.noise[r, k, i]
        if paths.used[mask, k]:
            add_rows(paths.ue_jacobian, m, k, scale, 0, root, rows)
            if block != NONE:
                add_rows(paths.landmark_jacobian, m, k, scale, block, root, rows)
    sound = cholesky(factor, dim)
    forward_columns(factor, rows, dim)
    return sound


@jit
def add_rows(
    jacobian: FloatArray,
    m: int,
    k: int,
    scale: float,
    first: int,
    root: FloatArray,
    rows: FloatArray,
) -> None:
    """Adds to row k a multiple of row k of Jacobian m (M, 6, b) times rows first ... of L."""
    for i in range(jacobian.shape[2]):
        factor = scale * jacobian[m, k, i]
        for j in range(first + i + 1):  # L is lower triangular
            rows[k, j] += factor * root[first + i, j]


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
