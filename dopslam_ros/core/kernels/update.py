"""The Gaussian update of every hypothesis.

A path that all hypotheses give to the same source is worked into the covariance once. What they
do not agree on makes a tree: P under a hypothesis is P before less W'W of each branch on its way,
and nobody needs to write that matrix down.
"""

from __future__ import annotations

import numpy as np

from dopslam_ros.core.arrays import FloatArray, IntArray
from dopslam_ros.core.channel import DIM
from dopslam_ros.core.kernels.compiled import part, part_of_one
from dopslam_ros.core.kernels.records import NONE, UE, Evidence, Observed, Updated
from dopslam_ros.core.kernels.small import cholesky

# Paths that are worked into a covariance in one go: their rows W must fit into the cache.
BLOCK = 8


@part
def project(
    mean: FloatArray,
    prior: FloatArray,
    covariance: FloatArray,
    gains: FloatArray,
    chain: IntArray,
    source: int,
    path: int,
    evidence: Evidence,
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
    a, b = evidence.ue_jacobian[source], evidence.landmark_jacobian[source]
    used = observed.used[path]
    column = UE + 3 * (source - 1)
    s, v = observed.noise[path].copy(), evidence.innovation[source, path].copy()
    w[:, :] = 0.0
    for c in range(DIM):
        if not used[c]:
            continue
        row = w[c]
        for i in range(UE):
            v[c] -= a[c, i] * (mean[i] - prior[i])
            add_row(a[c, i], covariance[i], row)
        if source > 0:
            for i in range(3):
                v[c] -= b[c, i] * (mean[column + i] - prior[column + i])
                add_row(b[c, i], covariance[column + i], row)
        for before in chain:
            subtract_earlier(gains[before], column, a[c], b[c], row)
        for other in range(c + 1):
            if used[other]:
                for j in range(UE):
                    s[c, other] += row[j] * a[other, j]
                if source > 0:
                    for j in range(3):
                        s[c, other] += row[column + j] * b[other, j]
    if not cholesky(s, len(s)):
        return np.nan
    distance = 0.0
    for k in range(DIM):
        row = w[k]
        for i in range(k):
            v[k] -= s[k, i] * v[i]
            add_row(-s[k, i], w[i], row)
        scale = 1.0 / s[k, k]
        v[k] *= scale
        distance += v[k] * v[k]
        for j in range(len(row)):
            row[j] *= scale
        add_row(v[k], row, mean)
    return distance


@part
def add_row(factor: float, row: FloatArray, total: FloatArray) -> None:
    """total (n,) += factor row (n,)."""
    if factor != 0.0:
        for j in range(len(total)):
            total[j] += factor * row[j]


@part
def subtract_earlier(
    g: FloatArray, column: int, a: FloatArray, b: FloatArray, row: FloatArray
) -> None:
    """Takes from a row of H P what an update W = g (6, n) has taken from P; column < 4 for the BS.

    Args:
        g: (6, n).
        column: where the component's block begins, less than 4 for the BS.
        a: (4,) row of the Jacobian by the vehicle.
        b: (3,) by the component.
        row: (n,).
    """
    f = np.empty(DIM)
    for k in range(DIM):
        total = 0.0
        for i in range(UE):
            total += a[i] * g[k, i]
        if column >= UE:
            for i in range(3):
                total += b[i] * g[k, column + i]
        f[k] = total
    subtract_rows(g, f, row)


@part
def subtract_rows(g: FloatArray, f: FloatArray, row: FloatArray) -> None:
    """row (m,) -= f (6,) g (6, n), of which the first m columns count."""
    f0, f1, f2, f3, f4, f5 = f[0], f[1], f[2], f[3], f[4], f[5]
    g0, g1, g2, g3, g4, g5 = g[0], g[1], g[2], g[3], g[4], g[5]
    for j in range(len(row)):
        row[j] -= (f0 * g0[j] + f1 * g1[j] + f2 * g2[j]) + (f3 * g3[j] + f4 * g4[j] + f5 * g5[j])


@part
def work_in(covariance: FloatArray, gains: FloatArray, count: int) -> None:
    """Takes W'W of the first so many updates (B, 6, n) from a covariance (n, n)."""
    f = np.empty(DIM)
    for i in range(len(covariance)):
        row = covariance[i, : i + 1]
        for update in range(count):
            for k in range(DIM):
                f[k] = gains[update, k, i]
            subtract_rows(gains[update], f, row)
        for j in range(i):
            covariance[j, i] = row[j]


@part
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


@part
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


@part_of_one
def agreed_update(
    mean: FloatArray,
    covariance: FloatArray,
    evidence: Evidence,
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


@part_of_one
def condition(
    mean: FloatArray,
    covariance: FloatArray,
    evidence: Evidence,
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
        means[row] = behind[chain[length - 1]] if length > 0 else trunk
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
            behind[branch], distances[branch], first[branch] = means[row], nis[row], at
            chain[length], depths[length] = branch, depth
            length += 1
            branch += 1
    sound = True
    for h in range(rows):
        sound = sound and nis[h] >= 0.0
    return Updated(left, means, nis, place, first, last, gains, sound)
