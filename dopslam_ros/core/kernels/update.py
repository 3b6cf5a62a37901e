"""The Gaussian update of every hypothesis, and their merge."""

from __future__ import annotations

import numpy as np

from dopslam_ros.core.arrays import BoolArray, FloatArray, IntArray
from dopslam_ros.core.channel import DIM
from dopslam_ros.core.kernels.compiled import compiled
from dopslam_ros.core.kernels.small import cholesky, used_places

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
) -> float:
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
        v' S^-1 v of the innovation v given the paths before, so that the sum over a hypothesis is
        that of all its paths jointly; NaN where S is not positive definite.
    """
    n = mean.shape[0]
    column = UE + 3 * (source - 1)
    s = np.empty((DIM, DIM))
    v = np.empty(DIM)
    place = np.empty(DIM, np.int64)
    count = used_places(used, place)
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
        return np.nan
    # w becomes L^-1 H P, v becomes L^-1 innovation.
    distance = 0.0
    for k in range(count):
        for i in range(k):
            factor = s[k, i]
            v[k] -= factor * v[i]
            for j in range(n):
                w[k, j] -= factor * w[i, j]
        scale = 1.0 / s[k, k]
        v[k] *= scale
        distance += v[k] * v[k]
        for j in range(n):
            w[k, j] *= scale
    for i in range(n):
        for k in range(count):
            factor = w[k, i]
            mean[i] += factor * v[k]
            if factor != 0.0:
                for j in range(n):
                    covariance[i, j] -= factor * w[k, j]
    return distance


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
    distances: FloatArray,
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
        distances: (H,) result: v' S^-1 v of the innovations of all paths that are given away.

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
    distance_kept = np.empty(rows)
    kept = 0
    for place in range(rows):
        row = row_order[place]
        start = common[place]
        if place == 0:
            means[row] = mean
            covariances[row] = covariance
            distances[row] = 0.0
        else:
            while depth_kept[kept - 1] > start:
                kept -= 1
            means[row] = mean_kept[kept - 1]
            covariances[row] = covariance_kept[kept - 1]
            distances[row] = distance_kept[kept - 1]
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
                distance_kept[kept] = distances[row]
                depth_kept[kept] = depth
                kept += 1
            if depth == paths:
                break
            path = path_order[depth]
            m = source[row, path]
            if m < 0:
                continue
            distances[row] += absorb(
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
            )
            if not distances[row] >= 0.0:
                return False
    return True


@compiled
def judge(
    detection: FloatArray,
    existence: FloatArray,
    component_track: IntArray,
    component_weight: FloatArray,
    birth_track: IntArray,
    source: IntArray,
    existences: FloatArray,
    type_weights: FloatArray,
) -> None:
    """Existence and type of every landmark under every hypothesis.

    Args:
        detection: (C0 + 1,) p_D of the sources; the components from C0 on are births.
        existence: (T,) before, of births given that their path is free.
        component_track: (C,).
        component_weight: (C,).
        birth_track: (J,) track born from each path, or -1.
        source: (H, J) source of each path, or -1.
        existences: (H, T) result.
        type_weights: (H, C) result.
    """
    rows, paths = source.shape
    components, tracks = len(component_track), len(existence)
    surviving = component_weight.copy()
    for c in range(len(detection) - 1):
        surviving[c] *= 1.0 - detection[c + 1]
    unseen = np.zeros(tracks)
    for c in range(components):
        unseen[component_track[c]] += surviving[c]
    for h in range(rows):
        for t in range(tracks):
            missed = existence[t] * unseen[t]
            existences[h, t] = missed / max(1.0 - existence[t] + missed, 1e-300)
        for c in range(components):
            type_weights[h, c] = surviving[c] / max(unseen[component_track[c]], 1e-300)
        for j in range(paths):
            if source[h, j] > 0:
                detected = source[h, j] - 1
                track = component_track[detected]
                existences[h, track] = 1.0
                for c in range(components):
                    if component_track[c] == track:
                        type_weights[h, c] = 1.0 if c == detected else 0.0
            if birth_track[j] >= 0:
                free = source[h, j] == -1
                existences[h, birth_track[j]] = existence[birth_track[j]] if free else 0.0


@compiled
def birth_existences(
    log_intensity: FloatArray,
    new: FloatArray,
    weight: FloatArray,
    track: IntArray,
    least: float,
    existence: FloatArray,
    kept: BoolArray,
) -> None:
    """How likely the landmarks born from each path exist, and whether they are worth keeping.

    Args:
        log_intensity: (2, J) ln rho by type.
        new: (J,) ln (c + rho).
        weight: (H,).
        track: (H, J) track of each path, -1 for clutter or new.
        least: existence below which a landmark would be pruned at once.
        existence: (J,) result: rho / (c + rho), where the path is given to no landmark.
        kept: (J,) result.
    """
    for j in range(len(new)):
        high = max(log_intensity[0, j], log_intensity[1, j])
        low = min(log_intensity[0, j], log_intensity[1, j])
        existence[j] = 0.0
        if high > -np.inf:
            existence[j] = np.exp(high - new[j]) * (1.0 + np.exp(low - high))
        free = 0.0
        for h in range(len(weight)):
            if track[h, j] == -1:
                free += weight[h]
        kept[j] = existence[j] * free > least


@compiled
def select_births(
    log_intensity: FloatArray,
    kept: BoolArray,
    least: float,
    path: IntArray,
    kind: IntArray,
    share: FloatArray,
) -> int:
    """Components of the births that are kept, by path, then type.

    Args:
        log_intensity: (2, J) ln rho by type.
        kept: (J,).
        least: types with a smaller share are dropped.
        path: (2 J,) result, as are the next two: the path of each component.
        kind: (2 J,) its type, 0 or 1.
        share: (2 J,) probability of the type.

    Returns:
        How many components there are.
    """
    count = 0
    for j in range(len(kept)):
        if not kept[j]:
            continue
        high = max(log_intensity[0, j], log_intensity[1, j])
        first, second = np.exp(log_intensity[0, j] - high), np.exp(log_intensity[1, j] - high)
        total = first + second
        if first < least * total:
            first = 0.0
        if second < least * total:
            second = 0.0
        for k in range(2):
            part = first if k == 0 else second
            if part > 0.0:
                path[count], kind[count] = j, k
                share[count] = part / (first + second)
                count += 1
    return count


@compiled
def place_births(
    ue: FloatArray,
    ue_height: float,
    covariance: FloatArray,
    axes: FloatArray,
    positions: FloatArray,
    covariances: FloatArray,
    position_gains: FloatArray,
    placements: FloatArray,
    spreads: FloatArray,
    gains: FloatArray,
) -> None:
    """Births in their frames, of which the first axis points at them from the vehicle.

    Args:
        ue: (4,) the vehicle they were fitted to.
        ue_height: [m].
        covariance: (n, n) of the joint vector, the vehicle first.
        axes: (B, 3, 3) of the frames.
        positions: (B, 3) [m].
        covariances: (B, 3, 3) of the positions.
        position_gains: (B, 3, 4) d position / ds.
        placements: (B, 3) result: q.
        spreads: (B, 3, 3) result: covariance of q given the vehicle.
        gains: (B, 3, 4) result: dq/ds.
    """
    local = np.empty((3, 3))
    for birth in range(positions.shape[0]):
        offset = positions[birth].copy()
        offset[0] -= ue[0]
        offset[1] -= ue[1]
        offset[2] -= ue_height
        reach = np.sqrt(offset[0] ** 2 + offset[1] ** 2 + offset[2] ** 2)
        placements[birth, 0] = reach
        placements[birth, 1] = 0.0
        placements[birth, 2] = 0.0
        # dq/dx where the tangents are zero: the axes, those across scaled by the range.
        for r in range(3):
            scale = 1.0 if r == 0 else 1.0 / reach
            for c in range(3):
                local[r, c] = axes[birth, c, r] * scale
        for r in range(3):
            for k in range(UE):
                total = 0.0
                for c in range(3):
                    total += local[r, c] * position_gains[birth, c, k]
                gains[birth, r, k] = total
        for r in range(3):
            for d in range(r + 1):
                total = 0.0
                for i in range(3):
                    for j in range(3):
                        total += local[r, i] * covariances[birth, i, j] * local[d, j]
                for i in range(UE):
                    for j in range(UE):
                        total -= gains[birth, r, i] * covariance[i, j] * gains[birth, d, j]
                spreads[birth, r, d] = total
                spreads[birth, d, r] = total


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
    existences: FloatArray,
    type_weights: FloatArray,
    component_track: IntArray,
    means: FloatArray,
    covariances: FloatArray,
    existence: FloatArray,
    share: FloatArray,
    mean: FloatArray,
    covariance: FloatArray,
) -> None:
    """Moments over the hypotheses, each block with weights of its own.

    Args:
        weight: (H,) W, of the vehicle's block; W r u is that of a component's block.
        existences: (H, T) r.
        type_weights: (H, C) u.
        component_track: (C,).
        means: (H, n).
        covariances: (H, n, n).
        existence: (T,) result.
        share: (C,) result: probability of the component's type.
        mean: (n,) result.
        covariance: (n, n) result; between two blocks the weight is the geometric mean of theirs.
    """
    rows, n = means.shape
    components, tracks = len(component_track), len(existence)
    component_weight = np.empty((rows, components))
    of_track = np.zeros(tracks)
    existence[:] = 0.0
    for h in range(rows):
        for t in range(tracks):
            existence[t] += weight[h] * existences[h, t]
    for t in range(tracks):
        existence[t] = min(existence[t], 1.0)
    for c in range(components):
        total = 0.0
        for h in range(rows):
            support = weight[h] * existences[h, component_track[c]] * type_weights[h, c]
            component_weight[h, c] = support
            total += support
        # A component that no hypothesis supports is about to be dropped; any weights will do.
        for h in range(rows):
            component_weight[h, c] = component_weight[h, c] / total if total > 0.0 else weight[h]
        share[c] = total
        of_track[component_track[c]] += total
    for c in range(components):
        if of_track[component_track[c]] > 0.0:
            share[c] /= of_track[component_track[c]]
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


@compiled
def keep(
    mean: FloatArray,
    covariance: FloatArray,
    components: BoolArray,
    kept_mean: FloatArray,
    kept_covariance: FloatArray,
) -> None:
    """The vehicle's block and those of some components.

    Args:
        mean: (n,).
        covariance: (n, n).
        components: (C,) which are kept, K in number.
        kept_mean: (4 + 3 K,) result.
        kept_covariance: (4 + 3 K, 4 + 3 K) result.
    """
    index = np.empty(len(kept_mean), np.int64)
    index[:UE] = np.arange(UE)
    count = UE
    for c in range(len(components)):
        if components[c]:
            for k in range(3):
                index[count + k] = UE + 3 * c + k
            count += 3
    for i in range(count):
        kept_mean[i] = mean[index[i]]
        for j in range(count):
            kept_covariance[i, j] = covariance[index[i], index[j]]


@compiled
def uncouple(covariance: FloatArray) -> None:
    """Zeroes (n, n) between the vehicle's block and those of the components, in place."""
    n = covariance.shape[0]
    for i in range(n):
        mine = -1 if i < UE else (i - UE) // 3
        for j in range(n):
            if mine != (-1 if j < UE else (j - UE) // 3):
                covariance[i, j] = 0.0
