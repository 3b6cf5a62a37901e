"""The Gaussian update of every hypothesis, and their merge."""

from __future__ import annotations

import numpy as np

from dopslam_ros.core.arrays import BoolArray, FloatArray, IntArray
from dopslam_ros.core.channel import DIM
from dopslam_ros.core.kernels.compiled import compiled
from dopslam_ros.core.kernels.small import cholesky

UE = 4


@compiled
def absorb(
    mean: FloatArray,
    covariance: FloatArray,
    prior: FloatArray,
    source: int,
    a: FloatArray,
    b: FloatArray,
    innovation: FloatArray,
    used: BoolArray,
    noise: FloatArray,
    w: FloatArray,
) -> bool:
    """The update by one path, in place; one after the other they are the joint update.

    Args:
        mean: (n,) so far.
        covariance: (n, n) so far.
        prior: (n,) where h was linearised.
        source: 0 the BS, m component m - 1.
        a: (6, 4) Jacobian by the vehicle.
        b: (6, 3) by the component.
        innovation: (6,) at the prior.
        used: (6,) components of the path that count.
        noise: (6, 6) R.
        w: (6, n) work space.

    Returns:
        Whether the innovation's covariance was positive definite.
    """
    n = mean.shape[0]
    column = UE + 3 * (source - 1)
    s = np.empty((DIM, DIM))
    v = np.empty(DIM)
    count = 0
    place = np.empty(DIM, np.int64)
    for c in range(DIM):
        if used[c]:
            place[count] = c
            count += 1
    for k in range(count):
        c = place[k]
        v[k] = innovation[c]
        w[k, :] = 0.0
        for i in range(UE):
            v[k] -= a[c, i] * (mean[i] - prior[i])
            factor = a[c, i]
            if factor != 0.0:
                for j in range(n):
                    w[k, j] += factor * covariance[i, j]
        if source > 0:
            for i in range(3):
                v[k] -= b[c, i] * (mean[column + i] - prior[column + i])
                factor = b[c, i]
                if factor != 0.0:
                    for j in range(n):
                        w[k, j] += factor * covariance[column + i, j]
    for k in range(count):
        for i in range(k + 1):
            total = noise[place[k], place[i]]
            for j in range(UE):
                total += w[k, j] * a[place[i], j]
            if source > 0:
                for j in range(3):
                    total += w[k, column + j] * b[place[i], j]
            s[k, i] = total
    if not cholesky(s, count):
        return False
    # w becomes L^-1 H P, v becomes L^-1 innovation.
    for k in range(count):
        for i in range(k):
            factor = s[k, i]
            v[k] -= factor * v[i]
            for j in range(n):
                w[k, j] -= factor * w[i, j]
        scale = 1.0 / s[k, k]
        v[k] *= scale
        for j in range(n):
            w[k, j] *= scale
    for i in range(n):
        for k in range(count):
            factor = w[k, i]
            mean[i] += factor * v[k]
            if factor != 0.0:
                for j in range(n):
                    covariance[i, j] -= factor * w[k, j]
    return True


@compiled
def condition(
    mean: FloatArray,
    covariance: FloatArray,
    a: FloatArray,
    b: FloatArray,
    innovation: FloatArray,
    used: BoolArray,
    noise: FloatArray,
    source: IntArray,
    path_order: IntArray,
    row_order: IntArray,
    means: FloatArray,
    covariances: FloatArray,
) -> bool:
    """The update of every hypothesis; hypotheses that begin alike share the work.

    The paths are taken in ``path_order``, the hypotheses in ``row_order``: sorted by their
    sources in that order. So each begins where it parts from the one before.

    Args:
        mean: (n,) predicted.
        covariance: (n, n).
        a: (M, 6, 4) Jacobians by the vehicle.
        b: (M, 6, 3) by the components.
        innovation: (M, J, 6).
        used: (J, 6).
        noise: (J, 6, 6).
        source: (H, J) source of each path under each hypothesis, -1 for none.
        path_order: (J,).
        row_order: (H,).
        means: (H, n) result.
        covariances: (H, n, n) result.

    Returns:
        Whether all went well.
    """
    rows, paths = source.shape
    n = mean.shape[0]
    w = np.empty((DIM, n))
    # How many paths, in order, each hypothesis has in common with the one before.
    common = np.zeros(rows, np.int64)
    for place in range(1, rows):
        one, other = row_order[place - 1], row_order[place]
        while common[place] < paths and (
            source[one, path_order[common[place]]] == source[other, path_order[common[place]]]
        ):
            common[place] += 1
    # States on the way of the current hypothesis at which a later one parts from it.
    depth_kept = np.empty(rows, np.int64)
    mean_kept = np.empty((rows, n))
    covariance_kept = np.empty((rows, n, n))
    kept = 0
    for place in range(rows):
        row = row_order[place]
        start = common[place]
        if place == 0:
            means[row] = mean
            covariances[row] = covariance
        else:
            while depth_kept[kept - 1] > start:
                kept -= 1
            means[row] = mean_kept[kept - 1]
            covariances[row] = covariance_kept[kept - 1]
        for depth in range(start, paths + 1):
            parts = False
            for later in range(place + 1, rows):
                if common[later] < depth:
                    break
                if common[later] == depth:
                    parts = True
                    break
            if parts and (place == 0 or depth > start or kept == 0):
                mean_kept[kept] = means[row]
                covariance_kept[kept] = covariances[row]
                depth_kept[kept] = depth
                kept += 1
            if depth == paths:
                break
            path = path_order[depth]
            m = source[row, path]
            if m >= 0 and not absorb(
                means[row],
                covariances[row],
                mean,
                m,
                a[m],
                b[m],
                innovation[m, path],
                used[path],
                noise[path],
                w,
            ):
                return False
    return True


@compiled
def append(
    means: FloatArray,
    covariances: FloatArray,
    prior: FloatArray,
    placements: FloatArray,
    spreads: FloatArray,
    gains: FloatArray,
    more_means: FloatArray,
    more_covariances: FloatArray,
) -> None:
    """New components behind the old ones, under every hypothesis.

    Given the vehicle a birth depends on nothing else, so that it follows the vehicle's update.

    Args:
        means: (H, n).
        covariances: (H, n, n).
        prior: (4,) the vehicle the births were fitted to.
        placements: (B, 3) q of the births.
        spreads: (B, 3, 3) their covariances given the vehicle.
        gains: (B, 3, 4) dq/ds.
        more_means: (H, n + 3 B) result.
        more_covariances: (H, n + 3 B, n + 3 B) result.
    """
    rows, n = means.shape
    births = placements.shape[0]
    for h in range(rows):
        mean, covariance = more_means[h], more_covariances[h]
        mean[:n] = means[h]
        covariance[:n, :n] = covariances[h]
        for birth in range(births):
            for c in range(3):
                i = n + 3 * birth + c
                mean[i] = placements[birth, c]
                covariance[i, :i] = 0.0
                for k in range(UE):
                    gain = gains[birth, c, k]
                    mean[i] += gain * (means[h, k] - prior[k])
                    # Columns up to here: the old ones, then the births before this one.
                    for j in range(i):
                        covariance[i, j] += gain * covariance[k, j]
                for j in range(i):
                    covariance[j, i] = covariance[i, j]
                own = spreads[birth, c, c]
                for k in range(UE):
                    own += gains[birth, c, k] * covariance[k, i]
                for d in range(c):
                    other = n + 3 * birth + d
                    covariance[i, other] += spreads[birth, c, d]
                    covariance[other, i] = covariance[i, other]
                covariance[i, i] = own


@compiled
def merge(
    weight: FloatArray,
    component_weight: FloatArray,
    means: FloatArray,
    covariances: FloatArray,
    mean: FloatArray,
    covariance: FloatArray,
) -> None:
    """Moments over the hypotheses, each block with weights of its own.

    Args:
        weight: (H,) of the vehicle's block.
        component_weight: (H, C) of the components' blocks.
        means: (H, n).
        covariances: (H, n, n).
        mean: (n,) result.
        covariance: (n, n) result; between two blocks the weight is the geometric mean of theirs.
    """
    rows, n = means.shape
    root = np.empty(n)
    deviation = np.empty((rows, n))
    mean[:] = 0.0
    covariance[:, :] = 0.0
    for h in range(rows):
        for i in range(n):
            share = weight[h] if i < UE else component_weight[h, (i - UE) // 3]
            mean[i] += share * means[h, i]
    for h in range(rows):
        for i in range(n):
            share = weight[h] if i < UE else component_weight[h, (i - UE) // 3]
            root[i] = np.sqrt(share)
            deviation[h, i] = root[i] * (means[h, i] - mean[i])
        for i in range(n):
            left, across = root[i], deviation[h, i]
            if left > 0.0:
                for j in range(n):
                    covariance[i, j] += (
                        left * covariances[h, i, j] * root[j] + across * deviation[h, j]
                    )
