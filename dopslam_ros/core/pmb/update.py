"""The joint Gaussian update of every hypothesis: p(s, q | Z, association).

A path that all hypotheses give to the same source is worked into the covariance once. What they
do not agree on makes a tree: P under a hypothesis is P before less W'W of each branch on its way,
and nobody needs to write that matrix down.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dopslam_ros.core.linalg.arrays import FloatArray, IntArray
from dopslam_ros.core.linalg.jit import jit, jit_inline
from dopslam_ros.core.linalg.small import cholesky, forward, forward_columns
from dopslam_ros.core.pmb.agreement import by_agreement, in_order
from dopslam_ros.core.pmb.density import block_of
from dopslam_ros.core.pmb.likelihood import Likelihoods, Observed
from dopslam_ros.core.settings.layout import BS_ID, DIM, NONE, Components

# Paths that are worked into a covariance in one go: their rows W must fit into the cache.
BATCH = 8


class Updated(NamedTuple):
    """The joint Gaussian under each of H hypotheses, in a form that they share.

    The updates by paths that all of them give to the same source are in ``covariance``. Each of
    the others is a branch: a run of hypotheses, taken in some order, with it has W'W less.

    Attributes:
        covariance: (n, n) P, before the branches.
        means: (H, n).
        nis: (H,) normalised innovation squared of all paths that are given away, jointly.
        rank: (H,) of each hypothesis in the order of the runs.
        first: (B,) first rank of the run of each branch.
        last: (B,) one beyond its last rank.
        gains: (B, 6, n) W.
        definite: whether every innovation's covariance was positive definite.
    """

    covariance: FloatArray
    means: FloatArray
    nis: FloatArray
    rank: IntArray
    first: IntArray
    last: IntArray
    gains: FloatArray
    definite: bool


class Linearised(NamedTuple):
    """The paths, and h of every source about the predicted mean: z - h(mean) - H (x - mean).

    Attributes:
        mean: (n,) predicted.
        vehicle: the vehicle's components; see ``Density``.
        start: (C + 1,) where the components' blocks begin; see ``Density``.
        likelihoods: Jacobians and innovations of the sources.
        observed: J paths.
    """

    mean: FloatArray
    vehicle: Components
    start: IntArray
    likelihoods: Likelihoods
    observed: Observed


@jit_inline
def predict_path(
    about: Linearised,
    mean: FloatArray,
    source: int,
    path: int,
    covariance: FloatArray,
    w: FloatArray,
) -> FloatArray:
    """H P of a source, (6, n) into w, zero where the path has nothing; its innovation (6,) there.

    Args:
        about: where h was linearised.
        mean: (n,) by now.
        source: 0 the BS, m component m - 1.
        path: that is given to it.
        covariance: (n, n) P.
        w: (6, n) result.
    """
    a, b = about.likelihoods.ue_jacobian, about.likelihoods.landmark_jacobian
    used, prior, n = about.observed.used, about.mean, len(mean)
    z_less_h, start = about.likelihoods.innovation, about.start
    innovation = np.empty(DIM)
    for c in range(DIM):
        innovation[c] = z_less_h[source, path, c]
        if not used[path, c]:
            for j in range(n):
                w[c, j] = 0.0
            continue
        for i in range(len(about.vehicle)):
            innovation[c] -= a[source, c, i] * (mean[i] - prior[i])
        if source == BS_ID:
            rows_in_pairs(a, source, c, covariance, about.vehicle, w, n)
            continue
        first, size = block_of(start, source)
        for i in range(size):
            innovation[c] -= b[source, c, i] * (mean[first + i] - prior[first + i])
        rows_of_source(a, b, source, c, covariance, about.vehicle, first, size, w, n)
    return innovation


@jit
def rows_of_source(
    a: FloatArray,
    b: FloatArray,
    source: int,
    c: int,
    covariance: FloatArray,
    vehicle: Components,
    first: int,
    size: int,
    w: FloatArray,
    n: int,
) -> None:
    """w[c] = A[c] P[vehicle] + B[c] P[landmark's block], the first n numbers."""
    for j in range(n):
        total = 0.0
        for i in range(len(vehicle)):
            total += a[source, c, i] * covariance[i, j]
        w[c, j] = total
    # A loop of its own: of fewer arrays the compiler can tell that they do not overlap.
    for j in range(n):
        total = 0.0
        for i in range(size):
            total += b[source, c, i] * covariance[first + i, j]
        w[c, j] += total


@jit
def rows_in_pairs(
    a: FloatArray,
    source: int,
    c: int,
    covariance: FloatArray,
    vehicle: Components,
    w: FloatArray,
    n: int,
) -> None:
    """w[c] = A[c] P[vehicle], the first n numbers, summed in pairs."""
    for j in range(n):
        total = 0.0
        for i in range(0, len(vehicle) - 1, 2):
            total += a[source, c, i] * covariance[i, j] + a[source, c, i + 1] * covariance[i + 1, j]
        for i in range(len(vehicle) - len(vehicle) % 2, len(vehicle)):
            total += a[source, c, i] * covariance[i, j]
        w[c, j] = total


@jit_inline
def innovation_covariance(
    about: Linearised, source: int, path: int, w: FloatArray, s: FloatArray
) -> None:
    """S = R + (H P) H', its lower triangle into s (6, 6), for w (6, n) = H P."""
    a, b = about.likelihoods.ue_jacobian, about.likelihoods.landmark_jacobian
    used, noise = about.observed.used, about.observed.noise
    first, size = block_of(about.start, source)
    for c in range(DIM):
        for other in range(c + 1):
            s[c, other] = noise[path, c, other]
            if not (used[path, c] and used[path, other]):
                continue
            for j in range(len(about.vehicle)):
                s[c, other] += w[c, j] * a[source, other, j]
            if source != BS_ID:
                for j in range(size):
                    s[c, other] += w[c, first + j] * b[source, other, j]


@jit
def update_by_path(
    about: Linearised,
    mean: FloatArray,
    covariance: FloatArray,
    gains: FloatArray,
    chain: IntArray,
    source: int,
    path: int,
    w: FloatArray,
) -> float:
    """The update by one path: mean + P H' S^-1 v, and W = L^-1 H P of P - W'W, where S = L L'.

    Args:
        about: where h was linearised.
        mean: (n,) so far, moved.
        covariance: (n, n) before the updates of the chain.
        gains: (B, 6, n) W of updates.
        chain: those that come before this one and are not in the covariance yet.
        source: 0 the BS, m component m - 1.
        path: that is given to it.
        w: (6, n) result: W, zero where the path has nothing.

    Returns:
        v' S^-1 v of the innovation v given the paths before, so that the sum over a hypothesis is
        that of all its paths jointly; NaN where S is not positive definite.
    """
    v = predict_path(about, mean, source, path, covariance, w)
    s, taken = np.empty((DIM, DIM)), np.empty((DIM, DIM))
    used, n = about.observed.used, len(mean)
    for before in chain:
        gain_of_source(gains, before, about, source, taken)
        for c in range(DIM):
            if used[path, c]:
                subtract_rows(gains, before, taken, c, w, c, n)
    innovation_covariance(about, source, path, w, s)
    if not cholesky(s, len(s)):
        return np.nan
    forward_columns(s, w, len(s))
    forward(s, v, len(s))
    v0, v1, v2, v3, v4, v5 = v[0], v[1], v[2], v[3], v[4], v[5]
    for j in range(n):
        mean[j] += (v0 * w[0, j] + v1 * w[1, j] + v2 * w[2, j]) + (
            v3 * w[3, j] + v4 * w[4, j] + v5 * w[5, j]
        )
    distance: float = (v0 * v0 + v1 * v1 + v2 * v2) + (v3 * v3 + v4 * v4 + v5 * v5)
    return distance


@jit
def gain_of_source(
    gains: FloatArray, update: int, about: Linearised, source: int, taken: FloatArray
) -> None:
    """H W' of a source and an update into taken (6, 6): H P has lost taken W by that update."""
    a, b = about.likelihoods.ue_jacobian, about.likelihoods.landmark_jacobian
    first, size = block_of(about.start, source)
    for c in range(DIM):
        for k in range(DIM):
            total = 0.0
            for i in range(len(about.vehicle)):
                total += a[source, c, i] * gains[update, k, i]
            if source != BS_ID:
                for i in range(size):
                    total += b[source, c, i] * gains[update, k, first + i]
            taken[c, k] = total


@jit
def subtract_rows(
    gains: FloatArray, update: int, f: FloatArray, c: int, rows: FloatArray, row: int, n: int
) -> None:
    """Takes the first n entries of f[c] W, W = gains[update] (6, n), from those of rows[row]."""
    f0, f1, f2, f3, f4, f5 = f[c, 0], f[c, 1], f[c, 2], f[c, 3], f[c, 4], f[c, 5]
    for j in range(n):
        rows[row, j] -= (
            f0 * gains[update, 0, j] + f1 * gains[update, 1, j] + f2 * gains[update, 2, j]
        ) + (f3 * gains[update, 3, j] + f4 * gains[update, 4, j] + f5 * gains[update, 5, j])


@jit
def work_in(covariance: FloatArray, gains: FloatArray, count: int) -> None:
    """Takes W'W of the first so many updates (B, 6, n) from a covariance (n, n)."""
    f = np.empty((count, DIM))
    for i in range(len(covariance)):
        for update in range(count):
            for k in range(DIM):
                f[update, k] = gains[update, k, i]
            subtract_rows(gains, update, f, update, covariance, i, i + 1)
        for j in range(i):
            covariance[j, i] = covariance[i, j]


@jit_inline
def agreed_update(
    about: Linearised, covariance: FloatArray, source: IntArray, order: IntArray
) -> tuple[FloatArray, FloatArray, float]:
    """Mean, covariance and squared distance after some paths, given to one source (J,) each."""
    moved, left, distance = about.mean.copy(), covariance.copy(), 0.0
    gains, numbers = np.empty((BATCH, DIM, len(moved))), np.arange(BATCH)
    at = 0
    while at < len(order):
        filled = 0
        while filled < BATCH and at < len(order):
            path = order[at]
            at += 1
            if source[path] == NONE:
                continue
            chain, w = numbers[:filled], gains[filled]
            distance += update_by_path(about, moved, left, gains, chain, source[path], path, w)
            filled += 1
        work_in(left, gains, filled)
    return moved, left, distance


@jit_inline
def condition(about: Linearised, covariance: FloatArray, source: IntArray) -> Updated:
    """One joint EKF update of [s; q_1 ... q_C] per hypothesis (Section IV-B).

    Args:
        about: predicted; there may be components behind those that the likelihoods are of.
        covariance: (n, n) predicted.
        source: (H, J) source of each path under each hypothesis, or NONE.
    """
    hypotheses, paths = source.shape
    order, agreed = by_agreement(source)
    sequence, common = in_order(source, order)
    trunk, left, distance = agreed_update(about, covariance, source[0], order[:agreed])
    n, count = len(about.mean), 0
    for at in range(hypotheses):
        for depth in range(common[at] if at > 0 else agreed, paths):
            count += source[sequence[at], order[depth]] != NONE
    first, last = np.zeros(count, np.int64), np.full(count, hypotheses)
    gains, behind, distances = np.empty((count, DIM, n)), np.empty((count, n)), np.empty(count)
    rank, means = np.empty(hypotheses, np.int64), np.empty((hypotheses, n))
    nis = np.empty(hypotheses)
    # The branches on the way of the current hypothesis, and the depth of each.
    chain, depths, length = np.empty(paths, np.int64), np.empty(paths, np.int64), 0
    branch, definite = 0, True
    for at in range(hypotheses):
        h, start = sequence[at], common[at] if at > 0 else agreed
        while length > 0 and depths[length - 1] >= start:
            length -= 1
            last[chain[length]] = at
        rank[h] = at
        for j in range(n):
            means[h, j] = behind[chain[length - 1], j] if length > 0 else trunk[j]
        nis[h] = distances[chain[length - 1]] if length > 0 else distance
        for depth in range(start, paths):
            path = order[depth]
            if source[h, path] == NONE:
                continue
            so_far, w = chain[:length], gains[branch]
            nis[h] += update_by_path(about, means[h], left, gains, so_far, source[h, path], path, w)
            for j in range(n):
                behind[branch, j] = means[h, j]
            distances[branch], first[branch] = nis[h], at
            chain[length], depths[length] = branch, depth
            length += 1
            branch += 1
        definite = definite and nis[h] >= 0.0
    return Updated(left, means, nis, rank, first, last, gains, definite)
