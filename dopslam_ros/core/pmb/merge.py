"""From a density under each hypothesis to one PMB density: the track-oriented merge.

Under hypothesis h of weight W_h the vehicle has the density p_h(s), and track t exists with
probability r_ht and then has the density p_ht(x). Of all PMB densities whose tracks are these, the
nearest to the mixture in Kullback-Leibler divergence has

    p(s) = sum_h W_h p_h(s),    r_t = sum_h W_h r_ht,    p_t(x) = sum_h W_h r_ht p_ht(x) / r_t.

With u_hc the probability of a type, its component c of p_t is weighted by W_h r_ht u_hc; a mixture
of Gaussians becomes the Gaussian of the same mean and covariance.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dopslam_ros.core.linalg.arrays import FloatArray, IntArray
from dopslam_ros.core.linalg.jit import jit, jit_inline
from dopslam_ros.core.pmb.density import Density, block_starts
from dopslam_ros.core.pmb.merge_gaussian import merged_covariance, merged_mean
from dopslam_ros.core.pmb.update import Updated
from dopslam_ros.core.settings.filtering import Constants
from dopslam_ros.core.settings.layout import NONE


@jit_inline
def existence_and_types(
    density: Density, detection: FloatArray, birth_track: IntArray, source: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Existence r_ht and types u_hc of every landmark under every hypothesis, by Bayes' rule.

    A landmark that a path is given to exists, and is of the type of the component that was
    detected. One that is missed is missed with probability q_t = sum_c u_c (1 - p_D,c) if it
    exists:

        r_ht = r_t q_t / (1 - r_t + r_t q_t),    u_hc = u_c (1 - p_D,c) / q_t.

    Args:
        density: before; births exist as they do given that their path is given to no landmark.
        detection: (C0 + 1,) p_D of the sources; the components from C0 on are births.
        birth_track: (J,) track born from each path, or NONE.
        source: (H, J) source of each path, or NONE.

    Returns:
        (H, T) probabilities that the tracks exist, (H, C) that of the components' types.
    """
    hypotheses, paths = source.shape
    existence, component_track = density.existence, density.component_track
    components, tracks = len(component_track), len(existence)
    existences, types = np.empty((hypotheses, tracks)), np.empty((hypotheses, components))
    component_missed = density.component_weight.copy()
    for c in range(len(detection) - 1):
        component_missed[c] *= 1.0 - detection[c + 1]
    track_missed = np.zeros(tracks)
    for c in range(components):
        track_missed[component_track[c]] += component_missed[c]
    for h in range(hypotheses):
        for t in range(tracks):
            missed = existence[t] * track_missed[t]
            existences[h, t] = missed / max(1.0 - existence[t] + missed, 1e-300)
        for c in range(components):
            types[h, c] = component_missed[c] / max(track_missed[component_track[c]], 1e-300)
        for j in range(paths):
            if source[h, j] > 0:
                detected = source[h, j] - 1
                track = component_track[detected]
                existences[h, track] = 1.0
                for c in range(components):
                    if component_track[c] == track:
                        types[h, c] = 1.0 if c == detected else 0.0
            if birth_track[j] != NONE:
                free = source[h, j] == NONE
                existences[h, birth_track[j]] = existence[birth_track[j]] if free else 0.0
    return existences, types


@jit_inline
def merge_weights(
    weight: FloatArray, conditioned: Conditioned
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The weights of the hypotheses in each block of the joint vector, and what they add up to.

    Args:
        weight: (H,) W_h, those of the vehicle's block; a component's block has W_h r_ht u_hc.
        conditioned: r_ht and u_hc.

    Returns:
        (H, 1 + C) weights of vehicle and components, normalised over the hypotheses, (T,) existence
        of the tracks, (C,) probability of the component's type.
    """
    owner, existences = conditioned.density.component_track, conditioned.existence
    hypotheses, tracks = existences.shape
    weights, share = np.empty((hypotheses, 1 + len(owner))), np.empty(len(owner))
    existence, of_track = np.zeros(tracks), np.zeros(tracks)
    for h in range(hypotheses):
        weights[h, 0] = weight[h]
        for t in range(tracks):
            existence[t] += weight[h] * existences[h, t]
    for t in range(tracks):
        existence[t] = min(existence[t], 1.0)
    for c in range(len(owner)):
        share[c] = 0.0
        for h in range(hypotheses):
            weights[h, 1 + c] = weight[h] * existences[h, owner[c]] * conditioned.type_weight[h, c]
            share[c] += weights[h, 1 + c]
        # What has no weight under any hypothesis is about to be dropped; any weights will do.
        for h in range(hypotheses):
            weights[h, 1 + c] = weights[h, 1 + c] / share[c] if share[c] > 0.0 else weight[h]
        of_track[owner[c]] += share[c]
    for c in range(len(owner)):
        if of_track[owner[c]] > 0.0:
            share[c] /= of_track[owner[c]]
    return weights, existence, share


@jit_inline
def merge(weight: FloatArray, conditioned: Conditioned, constants: Constants) -> Density:
    """One PMB density in place of one under each hypothesis; what is unlikely is dropped.

    This is the step from PMBM to PMB at the end of Section IV-B.

    Args:
        weight: (H,) of the hypotheses; of one that has all of it, this is the density under it.
        conditioned: the density under each.
        constants: what is unlikely, and whether blocks stay correlated.
    """
    density, updated = conditioned.density, conditioned.updated
    weights, existence, share = merge_weights(weight, conditioned)
    components, tracks = likely(density.component_track, existence, share, constants)
    owner = renumbered(density.component_track, components, tracks)
    types, type_weight = kept_types(density.component_type, share, components, owner, len(tracks))
    origin, axes = kept_frames(density.origin, density.axes, components)
    ids, exist = np.empty_like(tracks), np.empty(len(tracks))
    for k in range(len(tracks)):
        ids[k], exist[k] = density.track_id[tracks[k]], existence[tracks[k]]
    start = block_starts(density.start[0], types)
    mean, deviation, index = merged_mean(updated.means, weights, density.start, components)
    roots = np.empty((len(weight), 1 + len(components)))
    for h in range(len(weight)):
        roots[updated.rank[h], 0] = math.sqrt(weights[h, 0])
        for k in range(len(components)):
            roots[updated.rank[h], 1 + k] = math.sqrt(weights[h, 1 + components[k]])
    return Density(
        mean,
        merged_covariance(updated, roots, deviation, index, start, constants.joint),
        density.vehicle,
        start,
        origin,
        axes,
        owner,
        types,
        type_weight,
        ids,
        exist,
        density.undetected,
        density.next_id,
    )


@jit
def likely(
    owner: IntArray, existence: FloatArray, share: FloatArray, constants: Constants
) -> tuple[IntArray, IntArray]:
    """The tracks that are likely enough to be kept, and their components that are.

    Args:
        owner: (C,) track of each component.
        existence: (T,).
        share: (C,) probability of the component's type.
        constants: what is likely enough.

    Returns:
        Components and tracks, in order.
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
def kept_types(
    types: IntArray, share: FloatArray, components: IntArray, owner: IntArray, tracks: int
) -> tuple[IntArray, FloatArray]:
    """Types of the K components that are kept, and their probabilities, normalised in each track.

    Args:
        types: (C,) of all components.
        share: (C,) their probabilities.
        components: (K,) that are kept.
        owner: (K,) their tracks, of those that are kept.
        tracks: how many these are.
    """
    kept, weight = np.empty(len(components), np.int64), np.empty(len(components))
    of_track = np.zeros(tracks)
    for k in range(len(components)):
        kept[k], weight[k] = types[components[k]], share[components[k]]
        of_track[owner[k]] += weight[k]
    for k in range(len(components)):
        weight[k] /= of_track[owner[k]]
    return kept, weight


@jit
def kept_frames(
    origin: FloatArray, axes: FloatArray, components: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Origins (K, 3) and axes (K, 3, 3) of the components that are kept."""
    kept_origin = np.empty((len(components), origin.shape[1]))
    kept_axes = np.empty((len(components), axes.shape[1], axes.shape[2]))
    for k in range(len(components)):
        c = components[k]
        for i in range(origin.shape[1]):
            kept_origin[k, i] = origin[c, i]
            for j in range(axes.shape[2]):
                kept_axes[k, i, j] = axes[c, i, j]
    return kept_origin, kept_axes


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
