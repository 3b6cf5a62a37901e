"""From a density under each association to one density: existence, types, moments."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dopslam_ros.core.linalg.arrays import FloatArray, IntArray
from dopslam_ros.core.linalg.jit import from_python, jit, jit_inline
from dopslam_ros.core.pmb.density import Density, block_starts, blocks_of
from dopslam_ros.core.pmb.update import Updated
from dopslam_ros.core.settings.filtering import Constants
from dopslam_ros.core.settings.layout import DIM, NONE, SPACE


@jit_inline
def existence_and_type(
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
def block_weights(
    weight: FloatArray, conditioned: Conditioned
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The weight of each hypothesis in each block of the joint vector: W, or W r u, normalised.

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
    shares, existence, share = block_weights(weight, conditioned)
    components, tracks = likely(density.component_track, existence, share, constants)
    index, types = kept_columns(density, components)
    start = block_starts(density.start[0], types)
    block = blocks_of(start)
    roots = np.empty((len(weight), 1 + len(components)))
    for h in range(len(weight)):
        roots[updated.rank[h], 0] = math.sqrt(shares[h, 0])
        for k in range(len(components)):
            roots[updated.rank[h], 1 + k] = math.sqrt(shares[h, 1 + components[k]])
    mean, deviation = moments(updated.means, shares, index, blocks_of(density.start))
    owner = renumbered(density.component_track, components, tracks)
    size = len(components)
    origin, axes = np.empty((size, SPACE)), np.empty((size, SPACE, SPACE))
    of_type, of_track = np.empty(size), np.zeros(len(tracks))
    ids, exist = np.empty_like(tracks), np.empty(len(tracks))
    for k in range(size):
        c = components[k]
        of_type[k] = share[c]
        of_track[owner[k]] += of_type[k]
        for i in range(SPACE):
            origin[k, i] = density.origin[c, i]
            for j in range(SPACE):
                axes[k, i, j] = density.axes[c, i, j]
    for k in range(size):
        of_type[k] /= of_track[owner[k]]
    for k in range(len(tracks)):
        ids[k], exist[k] = density.track_id[tracks[k]], existence[tracks[k]]
    return Density(
        mean,
        merged_covariance(updated, roots, deviation, index, start, block, constants.joint),
        density.vehicle,
        start,
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
def likely(
    owner: IntArray, existence: FloatArray, share: FloatArray, constants: Constants
) -> tuple[IntArray, IntArray]:
    """Tracks that exist likely enough, and their components of types that are likely enough.

    Args:
        owner: (C,) track of each component.
        existence: (T,).
        share: (C,) probability of the component's type.
        constants: what is likely enough.

    Returns:
        The components and the tracks, by index.
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
def kept_columns(density: Density, components: IntArray) -> tuple[IntArray, IntArray]:
    """(n,) where in the joint vector the vehicle and some components are; (K,) their types."""
    size = density.start[0]
    for c in components:
        size += density.start[c + 1] - density.start[c]
    index, types = np.arange(size), np.empty(len(components), np.int64)
    at = density.start[0]
    for k in range(len(components)):
        c = components[k]
        types[k] = density.component_type[c]
        for i in range(density.start[c], density.start[c + 1]):
            index[at] = i
            at += 1
    return index, types


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
    means: FloatArray, shares: FloatArray, index: IntArray, block: IntArray
) -> tuple[FloatArray, FloatArray]:
    """The mean (n,) over the hypotheses, and (H, n) deviations times the roots of their weights.

    Args:
        means: (H, m).
        shares: (H, 1 + C) weights of vehicle and components.
        index: (n,) which of the m are wanted.
        block: (m,) to which block each belongs, 0 the vehicle's.
    """
    rows = len(means)
    mean, deviation = np.zeros(len(index)), np.zeros((rows, len(index)))
    for i in range(len(index)):
        at = index[i]
        for h in range(rows):
            mean[i] += shares[h, block[at]] * means[h, at]
        for h in range(rows):
            deviation[h, i] = math.sqrt(shares[h, block[at]]) * (means[h, at] - mean[i])
    return mean, deviation


@jit
def merged_covariance(
    updated: Updated,
    roots: FloatArray,
    deviation: FloatArray,
    index: IntArray,
    start: IntArray,
    block: IntArray,
    joint: bool,
) -> FloatArray:
    """The covariance (n, n) within the hypotheses and between them.

    Args:
        updated: the covariance under each hypothesis.
        roots: (H, 1 + K) of the weights of vehicle and components, in the order of the runs.
        deviation: (H, n) of the means, times the roots.
        index: (n,) columns of vehicle and components.
        start: (K + 1,) where the components' blocks begin among these.
        block: (n,) to which block each belongs, 0 the vehicle's.
        joint: whether the blocks are correlated.
    """
    n, branches = len(index), len(updated.gains)
    covariance, together = np.zeros((n, n)), np.empty(n)
    gains = np.empty((branches, DIM, n))
    for branch in range(branches):
        for k in range(DIM):
            for i in range(n):
                gains[branch, k, i] = updated.gains[branch, k, index[i]]
    high = 0
    for number in range(roots.shape[1]):
        low, high = high, start[number]
        begin = 0 if joint else low
        common_weight(roots, 0, len(roots), number, high, block, together)
        for i in range(low, high):
            for j in range(begin, i + 1):
                covariance[i, j] = together[j] * updated.covariance[index[i], index[j]]
        for branch in range(branches):
            first, last = updated.first[branch], updated.last[branch]
            if common_weight(roots, first, last, number, high, block, together):
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
def common_weight(
    roots: FloatArray,
    first: int,
    last: int,
    number: int,
    high: int,
    block: IntArray,
    together: FloatArray,
) -> bool:
    """The weight that some hypotheses have between a block and those up to it.

    Args:
        roots: (H, 1 + K) of all hypotheses.
        first: of those that count.
        last: one beyond them.
        number: of the block: 0 the vehicle, then the components.
        high: one beyond its last column.
        block: (n,) to which block each column belongs.
        together: (n,) result: of each column up to the end of the block.

    Returns:
        Whether there is any.
    """
    before, total = NONE, 0.0
    for i in range(high):
        if block[i] != before:
            before, total = block[i], 0.0
            for at in range(first, last):
                total += roots[at, number] * roots[at, before]
        together[i] = total
    return total > 0.0


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
def uncouple(covariance: FloatArray, start: IntArray) -> None:
    """Zeroes (n, n) between the blocks of vehicle and components, in place."""
    block = blocks_of(start)
    for i in range(len(block)):
        for j in range(len(block)):
            if block[i] != block[j]:
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
