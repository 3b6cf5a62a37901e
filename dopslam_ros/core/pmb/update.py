"""The Gaussian update of every hypothesis.

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
from dopslam_ros.core.pmb.likelihood import Likelihoods, Observed
from dopslam_ros.core.settings.layout import DIM, NONE, UE

# Paths that are worked into a covariance in one go: their rows W must fit into the cache.
BLOCK = 8


@jit
def project(
    mean: FloatArray,
    prior: FloatArray,
    covariance: FloatArray,
    gains: FloatArray,
    chain: IntArray,
    source: int,
    path: int,
    evidence: Likelihoods,
    observed: Observed,
    w: FloatArray,
) -> float:
    """The update by one path: moves the mean and finds W of P <- P - W'W.

    Args:
        mean: (n,) so far, moved.
        prior: (n,) where h was linearised.
        covariance: (n, n) before the updates of the chain.
        gains: (B, 6, n) W of updates.
        chain: those that come before this one and are not in the covariance yet.
        source: 0 the BS, m component m - 1.
        path: that is given to it.
        evidence: of the sources.
        observed: the paths.
        w: (6, n) result: L^-1 H P with S = L L', zero where the path has nothing.

    Returns:
        v' S^-1 v of the innovation v given the paths before, so that the sum over a hypothesis is
        that of all its paths jointly; NaN where S is not positive definite.
    """
    # Arrays and indices, not views: each view costs more than what is read through it.
    a, b, used = evidence.ue_jacobian, evidence.landmark_jacobian, observed.used
    column, n = UE + 3 * (source - 1), len(mean)
    s, v, f = np.empty((DIM, DIM)), np.empty(DIM), np.empty((DIM, DIM))
    for c in range(DIM):
        v[c] = evidence.innovation[source, path, c]
        for other in range(c + 1):
            s[c, other] = observed.noise[path, c, other]
        if not used[path, c]:
            for j in range(n):
                w[c, j] = 0.0
            continue
        a0, a1, a2, a3 = a[source, c, 0], a[source, c, 1], a[source, c, 2], a[source, c, 3]
        for i in range(UE):
            v[c] -= a[source, c, i] * (mean[i] - prior[i])
        if source == 0:
            for j in range(n):
                w[c, j] = (a0 * covariance[0, j] + a1 * covariance[1, j]) + (
                    a2 * covariance[2, j] + a3 * covariance[3, j]
                )
            continue
        b0, b1, b2 = b[source, c, 0], b[source, c, 1], b[source, c, 2]
        for i in range(3):
            v[c] -= b[source, c, i] * (mean[column + i] - prior[column + i])
        for j in range(n):
            w[c, j] = (
                a0 * covariance[0, j]
                + a1 * covariance[1, j]
                + a2 * covariance[2, j]
                + a3 * covariance[3, j]
            ) + (
                b0 * covariance[column, j]
                + b1 * covariance[column + 1, j]
                + b2 * covariance[column + 2, j]
            )
    for before in chain:
        multiply_gain(gains, before, a, b, source, f)
        for c in range(DIM):
            if used[path, c]:
                subtract_rows(gains, before, f, c, w, c, n)
    for c in range(DIM):
        if not used[path, c]:
            continue
        for other in range(c + 1):
            if not used[path, other]:
                continue
            for j in range(UE):
                s[c, other] += w[c, j] * a[source, other, j]
            if source > 0:
                for j in range(3):
                    s[c, other] += w[c, column + j] * b[source, other, j]
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
def multiply_gain(
    gains: FloatArray, update: int, a: FloatArray, b: FloatArray, source: int, f: FloatArray
) -> None:
    """H W' of a source and an update, so that f W is what the update has taken from H P.

    Args:
        gains: (B, 6, n) W of the updates.
        update: which of them.
        a: (C + 1, 6, 4) Jacobians by the vehicle.
        b: (C + 1, 6, 3) by the components.
        source: whose.
        f: (6, 6) result.
    """
    column = UE + 3 * (source - 1)
    for c in range(DIM):
        for k in range(DIM):
            total = 0.0
            for i in range(UE):
                total += a[source, c, i] * gains[update, k, i]
            if source > 0:
                for i in range(3):
                    total += b[source, c, i] * gains[update, k, column + i]
            f[c, k] = total


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


@jit
def by_agreement(source: IntArray) -> tuple[IntArray, int]:
    """(J,) the paths, those first which many of the hypotheses (H, J) treat as the first one does.

    What most agree on comes first, so that they share it; with how many all agree on.
    """
    rows, paths = source.shape
    agree = np.zeros(paths, np.int64)
    for h in range(rows):
        for j in range(paths):
            agree[j] += source[h, j] == source[0, j]
    order, common = np.empty(paths, np.int64), 0
    for j in range(paths):
        common += agree[j] == rows
        at = j
        while at > 0 and agree[order[at - 1]] < agree[j]:
            order[at] = order[at - 1]
            at -= 1
        order[at] = j
    return order, common


@jit
def in_order(source: IntArray, order: IntArray) -> tuple[IntArray, IntArray]:
    """The hypotheses (H, J) sorted by their sources of the paths in some order.

    Returns:
        (H,) which comes when, and (H,) how many paths in order each has in common with the one
        before.
    """
    rows, paths = source.shape
    sequence, common = np.empty(rows, np.int64), np.zeros(rows, np.int64)
    for h in range(rows):
        at = h
        while at > 0:
            before, depth = sequence[at - 1], 0
            while depth < paths and source[before, order[depth]] == source[h, order[depth]]:
                depth += 1
            if depth == paths or source[before, order[depth]] < source[h, order[depth]]:
                break
            sequence[at] = before
            at -= 1
        sequence[at] = h
    for at in range(1, rows):
        one, other = sequence[at - 1], sequence[at]
        while common[at] < paths and (
            source[one, order[common[at]]] == source[other, order[common[at]]]
        ):
            common[at] += 1
    return sequence, common


@jit_inline
def agreed_update(
    mean: FloatArray,
    covariance: FloatArray,
    evidence: Likelihoods,
    observed: Observed,
    source: IntArray,
    order: IntArray,
) -> tuple[FloatArray, FloatArray, float]:
    """Mean, covariance and squared distance after some paths, given to one source (J,) each."""
    moved, left, distance = mean.copy(), covariance.copy(), 0.0
    block, numbers = np.empty((BLOCK, DIM, len(mean))), np.arange(BLOCK)
    at = 0
    while at < len(order):
        filled = 0
        while filled < BLOCK and at < len(order):
            path = order[at]
            at += 1
            if source[path] == NONE:
                continue
            distance += project(
                moved,
                mean,
                left,
                block,
                numbers[:filled],
                source[path],
                path,
                evidence,
                observed,
                block[filled],
            )
            filled += 1
        work_in(left, block, filled)
    return moved, left, distance


@jit_inline
def condition(
    mean: FloatArray,
    covariance: FloatArray,
    evidence: Likelihoods,
    observed: Observed,
    source: IntArray,
) -> Updated:
    """One joint EKF update of [s; q_1 ... q_C] per hypothesis.

    Args:
        mean: (n,) predicted; there may be components behind those that the evidence is of.
        covariance: (n, n).
        evidence: of the sources.
        observed: J paths.
        source: (H, J) source of each path under each hypothesis, or NONE.
    """
    rows, paths = source.shape
    order, agreed = by_agreement(source)
    sequence, common = in_order(source, order)
    trunk, left, distance = agreed_update(
        mean, covariance, evidence, observed, source[0], order[:agreed]
    )
    count = 0
    for at in range(rows):
        for depth in range(common[at] if at > 0 else agreed, paths):
            count += source[sequence[at], order[depth]] != NONE
    first, last = np.zeros(count, np.int64), np.full(count, rows)
    gains, behind = np.empty((count, DIM, len(mean))), np.empty((count, len(mean)))
    distances = np.empty(count)
    place, means, nis = np.empty(rows, np.int64), np.empty((rows, len(mean))), np.empty(rows)
    # The branches on the way of the current hypothesis, and the depth of each.
    chain, depths, length = np.empty(paths, np.int64), np.empty(paths, np.int64), 0
    branch = 0
    for at in range(rows):
        row = sequence[at]
        start = common[at] if at > 0 else agreed
        while length > 0 and depths[length - 1] >= start:
            length -= 1
            last[chain[length]] = at
        place[row] = at
        for j in range(len(mean)):
            means[row, j] = behind[chain[length - 1], j] if length > 0 else trunk[j]
        nis[row] = distances[chain[length - 1]] if length > 0 else distance
        for depth in range(start, paths):
            path = order[depth]
            if source[row, path] == NONE:
                continue
            nis[row] += project(
                means[row],
                mean,
                left,
                gains,
                chain[:length],
                source[row, path],
                path,
                evidence,
                observed,
                gains[branch],
            )
            for j in range(len(mean)):
                behind[branch, j] = means[row, j]
            distances[branch], first[branch] = nis[row], at
            chain[length], depths[length] = branch, depth
            length += 1
            branch += 1
    sound = True
    for h in range(rows):
        sound = sound and nis[h] >= 0.0
    return Updated(left, means, nis, place, first, last, gains, sound)


class Updated(NamedTuple):
    """The joint Gaussian under each of H hypotheses, in a form that they share.

    The updates by paths that all of them give to the same source are in ``covariance``. Each of
    the others is a branch: a run of hypotheses, taken in some order, with it has W'W less.

    Attributes:
        covariance: (n, n) P, before the branches.
        means: (H, n).
        nis: (H,) normalised innovation squared of all paths that are given away, jointly.
        place: (H,) of each hypothesis in the order of the runs.
        first: (B,) first place of the run of each branch.
        last: (B,) one beyond its last place.
        gains: (B, 6, n) W.
        sound: whether the arithmetic went well.
    """

    covariance: FloatArray
    means: FloatArray
    nis: FloatArray
    place: IntArray
    first: IntArray
    last: IntArray
    gains: FloatArray
    sound: bool
