"""From a density under each association to one density: existence, types, moments."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dopslam_ros.core.linalg.arrays import FloatArray, IntArray
from dopslam_ros.core.linalg.jit import from_python, jit, jit_inline
from dopslam_ros.core.pmb.density import Density, block_starts
from dopslam_ros.core.pmb.update import Updated
from dopslam_ros.core.settings.filtering import Constants
from dopslam_ros.core.settings.layout import DIM, NONE, UE


@jit_inline
def judge(
    density: Density, detection: FloatArray, birth_track: IntArray, source: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Existence and type of every landmark under every hypothesis.

    Args:
        density: before; births exist as they do given that their path is free.
        detection: (C0 + 1,) p_D of the sources; the components from C0 on are births.
        birth_track: (J,) track born from each path, or NONE.
        source: (H, J) source of each path, or NONE.

    Returns:
        (H, T) probabilities that the tracks exist, (H, C) that of the components' types.
    """
    rows, paths = source.shape
    existence, component_track = density.existence, density.component_track
    components, tracks = len(component_track), len(existence)
    existences, type_weights = np.empty((rows, tracks)), np.empty((rows, components))
    surviving = density.component_weight.copy()
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
            if birth_track[j] != NONE:
                free = source[h, j] == NONE
                existences[h, birth_track[j]] = existence[birth_track[j]] if free else 0.0
    return existences, type_weights


@jit_inline
def supports(
    weight: FloatArray, conditioned: Conditioned
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """How much each hypothesis says of each block of the joint vector.

    Args:
        weight: (H,) W, of the vehicle's block; W r u is that of a component's block.
        conditioned: r and u.

    Returns:
        (H, 1 + C) normalised weights of vehicle and components, (T,) existence of the tracks, (C,)
        probability of the component's type.
    """
    owner, existences = conditioned.density.component_track, conditioned.existence
    rows, tracks = existences.shape
    shares, share = np.empty((rows, 1 + len(owner))), np.empty(len(owner))
    existence, of_track = np.zeros(tracks), np.zeros(tracks)
    for h in range(rows):
        shares[h, 0] = weight[h]
        for t in range(tracks):
            existence[t] += weight[h] * existences[h, t]
    for t in range(tracks):
        existence[t] = min(existence[t], 1.0)
    for c in range(len(owner)):
        share[c] = 0.0
        for h in range(rows):
            support = weight[h] * existences[h, owner[c]] * conditioned.type_weight[h, c]
            shares[h, 1 + c] = support
            share[c] += support
        # A component that no hypothesis supports is about to be dropped; any weights will do.
        for h in range(rows):
            shares[h, 1 + c] = shares[h, 1 + c] / share[c] if share[c] > 0.0 else weight[h]
        of_track[owner[c]] += share[c]
    for c in range(len(owner)):
        if of_track[owner[c]] > 0.0:
            share[c] /= of_track[owner[c]]
    return shares, existence, share


@jit_inline
def merge(weight: FloatArray, conditioned: Conditioned, constants: Constants) -> Density:
    """PMBM to PMB: moments matched over the hypotheses, block by block; what is unlikely dropped.

    The vehicle is weighted by W, a component by W r u: the track-oriented merge that is nearest in
    Kullback-Leibler divergence. Blocks have different weights, so the covariance between two is
    weighted by the geometric mean of theirs; the sum of congruences keeps it positive definite.

    Args:
        weight: (H,) of the hypotheses; of one that has all of it, this is the density under it.
        conditioned: the density under each.
        constants: what is unlikely, and whether blocks stay correlated.
    """
    density, updated = conditioned.density, conditioned.updated
    shares, existence, share = supports(weight, conditioned)
    components, tracks = kept_of(density.component_track, existence, share, constants)
    index = np.arange(UE + 3 * len(components))
    for k in range(len(components)):
        for i in range(3):
            index[UE + 3 * k + i] = UE + 3 * components[k] + i
    mean, deviation = moments(updated.means, shares, index)
    roots = np.empty((len(weight), 1 + len(components)))
    for h in range(len(weight)):
        roots[updated.place[h], 0] = math.sqrt(shares[h, 0])
        for k in range(len(components)):
            roots[updated.place[h], 1 + k] = math.sqrt(shares[h, 1 + components[k]])
    owner = renumbered(density.component_track, components, tracks)
    size = len(components)
    origin, axes, of_type = np.empty((size, 3)), np.empty((size, 3, 3)), np.empty(size)
    types, ids, exist = np.empty(size, np.int64), np.empty_like(tracks), np.empty(len(tracks))
    of_track = np.zeros(len(tracks))
    for k in range(size):
        c = components[k]
        types[k], of_type[k] = density.component_type[c], share[c]
        of_track[owner[k]] += of_type[k]
        for i in range(3):
            origin[k, i] = density.origin[c, i]
            for j in range(3):
                axes[k, i, j] = density.axes[c, i, j]
    for k in range(size):
        of_type[k] /= of_track[owner[k]]
    for k in range(len(tracks)):
        ids[k], exist[k] = density.track_id[tracks[k]], existence[tracks[k]]
    return Density(
        mean,
        spread(updated, roots, deviation, index, constants.joint),
        block_starts(density.start[0], types),
        origin,
        axes,
        owner,
        types,
        of_type,
        ids,
        exist,
        density.undetected,
        density.next_id,
    )


@jit
def kept_of(
    owner: IntArray, existence: FloatArray, share: FloatArray, constants: Constants
) -> tuple[IntArray, IntArray]:
    """Components of types that are likely enough, and the tracks that are; theirs are the others'.

    Args:
        owner: (C,) track of each component.
        existence: (T,).
        share: (C,) probability of the component's type.
        constants: what is likely enough.
    """
    components, tracks = np.empty(len(owner), np.int64), np.empty(len(existence), np.int64)
    count = 0
    for track in range(len(existence)):
        if existence[track] > constants.prune_existence:
            tracks[count] = track
            count += 1
    kept = 0
    for c in range(len(owner)):
        if existence[owner[c]] > constants.prune_existence and share[c] > constants.prune_type:
            components[kept] = c
            kept += 1
    return components[:kept], tracks[:count]


@jit
def renumbered(owner: IntArray, components: IntArray, tracks: IntArray) -> IntArray:
    """Tracks (C,) of the components that are kept, numbered as the tracks that are kept."""
    new = np.empty(len(components), np.int64)
    number = 0
    for k in range(len(components)):
        while tracks[number] != owner[components[k]]:
            number += 1
        new[k] = number
    return new


@jit
def moments(
    means: FloatArray, shares: FloatArray, index: IntArray
) -> tuple[FloatArray, FloatArray]:
    """The mean (n,) over the hypotheses, and (H, n) deviations times the roots of their weights.

    Args:
        means: (H, m).
        shares: (H, 1 + C) weights of vehicle and components.
        index: (n,) which of the m are wanted.
    """
    rows = len(means)
    mean, deviation = np.zeros(len(index)), np.zeros((rows, len(index)))
    for i in range(len(index)):
        at = index[i]
        block = 0 if at < UE else 1 + (at - UE) // 3
        for h in range(rows):
            mean[i] += shares[h, block] * means[h, at]
        for h in range(rows):
            deviation[h, i] = math.sqrt(shares[h, block]) * (means[h, at] - mean[i])
    return mean, deviation


@jit
def spread(
    updated: Updated, roots: FloatArray, deviation: FloatArray, index: IntArray, joint: bool
) -> FloatArray:
    """The covariance (n, n) within the hypotheses and between them.

    Args:
        updated: the covariance under each hypothesis.
        roots: (H, 1 + K) of the weights of vehicle and components, in the order of the runs.
        deviation: (H, n) of the means, times the roots.
        index: (n,) columns of vehicle and components.
        joint: whether the blocks are correlated.
    """
    n, branches = len(index), len(updated.gains)
    covariance = np.zeros((n, n))
    gains = np.empty((branches, DIM, n))
    for branch in range(branches):
        for k in range(DIM):
            for i in range(n):
                gains[branch, k, i] = updated.gains[branch, k, index[i]]
    together = np.empty(n)
    for block in range(roots.shape[1]):
        low = 0 if block == 0 else UE + 3 * (block - 1)
        high = UE if block == 0 else low + 3
        begin = 0 if joint else low
        weigh_together(roots, 0, len(roots), block, together)
        for i in range(low, high):
            for j in range(begin, i + 1):
                covariance[i, j] = together[j] * updated.covariance[index[i], index[j]]
        for branch in range(branches):
            first, last = updated.first[branch], updated.last[branch]
            if weigh_together(roots, first, last, block, together):
                for i in range(low, high):
                    subtract_weighted(gains, branch, i, begin, together, covariance)
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
def weigh_together(
    roots: FloatArray, first: int, last: int, block: int, together: FloatArray
) -> bool:
    """The weight that some hypotheses have between a block and those up to it.

    Args:
        roots: (H, 1 + K) of all hypotheses.
        first: of those that count.
        last: one beyond them.
        block: 0 the vehicle, then the components.
        together: (n,) result: of each column up to the end of the block.

    Returns:
        Whether there is any.
    """
    own = 0.0
    for other in range(block + 1):
        total = 0.0
        for at in range(first, last):
            total += roots[at, block] * roots[at, other]
        own = total
        if other == 0:
            for i in range(UE):
                together[i] = total
        else:
            for i in range(3):
                together[UE + 3 * (other - 1) + i] = total
    return own > 0.0


@jit
def subtract_weighted(
    gains: FloatArray,
    branch: int,
    i: int,
    begin: int,
    together: FloatArray,
    covariance: FloatArray,
) -> None:
    """Takes together (n,) times W'W, W = gains[branch] (6, n), from row i up to the diagonal."""
    g, b = gains, branch
    f0, f1, f2, f3, f4, f5 = g[b, 0, i], g[b, 1, i], g[b, 2, i], g[b, 3, i], g[b, 4, i], g[b, 5, i]
    for j in range(begin, i + 1):
        covariance[i, j] -= together[j] * (
            (f0 * g[b, 0, j] + f1 * g[b, 1, j] + f2 * g[b, 2, j])
            + (f3 * g[b, 3, j] + f4 * g[b, 4, j] + f5 * g[b, 5, j])
        )


@from_python
def uncouple(covariance: FloatArray) -> None:
    """Zeroes (n, n) between the vehicle's block and those of the components, in place."""
    n = covariance.shape[0]
    for i in range(n):
        mine = NONE if i < UE else (i - UE) // 3
        for j in range(n):
            if mine != (NONE if j < UE else (j - UE) // 3):
                covariance[i, j] = 0.0


class Conditioned(NamedTuple):
    """A density given each of its H associations.

    Attributes:
        density: predicted, the births behind the rest.
        birth_track: (J,) track of the landmark born from each path, or NONE.
        updated: the joint Gaussian of that under each association.
        existence: (H, T) probability that the track exists.
        type_weight: (H, C) probability of the component's type, given that the track exists.
    """

    density: Density
    birth_track: IntArray
    updated: Updated
    existence: FloatArray
    type_weight: FloatArray
