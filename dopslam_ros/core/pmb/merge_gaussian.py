"""Mean and covariance of a mixture of Gaussians whose blocks are weighted each in its own way."""

from __future__ import annotations

import math

import numpy as np

from dopslam_ros.core.linalg.arrays import FloatArray, IntArray
from dopslam_ros.core.linalg.jit import from_python, jit
from dopslam_ros.core.pmb.density import block_bounds, block_numbers
from dopslam_ros.core.pmb.update import Updated
from dopslam_ros.core.settings.layout import DIM


@jit
def merged_mean(
    means: FloatArray, weights: FloatArray, start: IntArray, components: IntArray
) -> tuple[FloatArray, FloatArray, IntArray]:
    """The mean m over the hypotheses, of the vehicle and the components that are kept.

    Args:
        means: (H, m) of the joint vector under each hypothesis, m_h.
        weights: (H, 1 + C) of vehicle and components.
        start: (C + 1,) where their blocks begin in the joint vector.
        components: (K,) those that are kept.

    Returns:
        (n,) m, (H, n) the deviations m_h - m times the roots of their weights, and (n,) which of
        the numbers of the joint vector are kept.
    """
    size = start[0]
    for c in components:
        size += start[c + 1] - start[c]
    index, filled = np.empty(size, np.int64), start[0]
    for i in range(start[0]):
        index[i] = i
    for c in components:
        for i in range(start[c], start[c + 1]):
            index[filled] = i
            filled += 1
    block = block_numbers(start)
    mean, deviation = np.zeros(size), np.zeros((len(means), size))
    for i in range(size):
        at = index[i]
        for h in range(len(means)):
            mean[i] += weights[h, block[at]] * means[h, at]
        for h in range(len(means)):
            deviation[h, i] = math.sqrt(weights[h, block[at]]) * (means[h, at] - mean[i])
    return mean, deviation, index


@jit
def merged_covariance(
    updated: Updated,
    roots: FloatArray,
    deviation: FloatArray,
    index: IntArray,
    start: IntArray,
    joint: bool,
) -> FloatArray:
    """The covariance (n, n): within the hypotheses, and between them,

        sum_h D_h (P_h + (m_h - m) (m_h - m)') D_h,    D_h = diag of the roots of the weights.

    Between two blocks the weight is thus the geometric mean of theirs, and as a sum of congruences
    the whole is positive semidefinite. P_h is P less W'W of every branch of updates on its way.

    Args:
        updated: P, the branches and the hypotheses that run through each.
        roots: (H, 1 + K) of the weights of vehicle and components, in the order of the runs.
        deviation: (H, n) of the means, times the roots.
        index: (n,) columns of vehicle and components in P.
        start: (K + 1,) where the blocks of the components begin in the result.
        joint: whether the blocks are correlated.
    """
    n, branches = len(index), len(updated.gains)
    covariance = np.zeros((n, n))
    gains = np.empty((branches, DIM, n))
    for branch in range(branches):
        for k in range(DIM):
            for i in range(n):
                gains[branch, k, i] = updated.gains[branch, k, index[i]]
    weight = np.empty(n)
    for block in range(roots.shape[1]):
        low, high = block_bounds(start, block)
        begin = 0 if joint else low
        joint_weights(roots, 0, len(roots), block, start, weight)
        for i in range(low, high):
            for j in range(begin, i + 1):
                covariance[i, j] = weight[j] * updated.covariance[index[i], index[j]]
        for branch in range(branches):
            first, last = updated.first[branch], updated.last[branch]
            if joint_weights(roots, first, last, block, start, weight):
                for i in range(low, high):
                    subtract_weighted(gains, branch, i, begin, weight, covariance)
        for i in range(low, high):
            for h in range(len(deviation)):
                factor = deviation[h, i]
                if factor != 0.0:
                    for j in range(begin, i + 1):
                        covariance[i, j] += factor * deviation[h, j]
            for j in range(begin, i):
                covariance[j, i] = covariance[i, j]
    return covariance


@jit
def joint_weights(
    roots: FloatArray, first: int, last: int, block: int, start: IntArray, weight: FloatArray
) -> bool:
    """The weight of a run of hypotheses between a block and each block up to it.

    Args:
        roots: (H, 1 + K) of all hypotheses.
        first: of the run.
        last: one beyond it.
        block: 0 the vehicle, then the components.
        start: (K + 1,) where the blocks of the components begin.
        weight: (n,) result: of each column up to the end of the block.

    Returns:
        Whether the block has any weight in the run.
    """
    own = 0.0
    for other in range(block + 1):
        total = 0.0
        for at in range(first, last):
            total += roots[at, block] * roots[at, other]
        own = total
        low, high = block_bounds(start, other)
        for i in range(low, high):
            weight[i] = total
    return own > 0.0


@jit
def subtract_weighted(
    gains: FloatArray, branch: int, i: int, begin: int, weight: FloatArray, covariance: FloatArray
) -> None:
    """Takes W'W, W = gains[branch] (6, n), from row i up to the diagonal, times weight (n,)."""
    g, b = gains, branch
    f0, f1, f2, f3, f4, f5 = g[b, 0, i], g[b, 1, i], g[b, 2, i], g[b, 3, i], g[b, 4, i], g[b, 5, i]
    for j in range(begin, i + 1):
        covariance[i, j] -= weight[j] * (
            (f0 * g[b, 0, j] + f1 * g[b, 1, j] + f2 * g[b, 2, j])
            + (f3 * g[b, 3, j] + f4 * g[b, 4, j] + f5 * g[b, 5, j])
        )


@from_python
def uncouple(covariance: FloatArray, start: IntArray) -> None:
    """Leaves of (n, n) only the blocks, in place: the marginals of eqs. (31), (32)."""
    block = block_numbers(start)
    for i in range(len(block)):
        for j in range(len(block)):
            if block[i] != block[j]:
                covariance[i, j] = 0.0
