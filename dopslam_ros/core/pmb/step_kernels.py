"""The step: rank the associations, update under each, conclude."""

from __future__ import annotations

import math

import numpy as np

from dopslam_ros.core.linalg.arrays import BoolArray, FloatArray, IntArray
from dopslam_ros.core.linalg.jit import from_python, jit
from dopslam_ros.core.models.channel_kernels import wrapped
from dopslam_ros.core.pmb.birth import propose
from dopslam_ros.core.pmb.hypotheses import associate, weigh_locally
from dopslam_ros.core.pmb.inactive_kernels import some_left_behind
from dopslam_ros.core.pmb.likelihood import weigh
from dopslam_ros.core.pmb.merge import judge, merge
from dopslam_ros.core.pmb.newborn import augment, newborn
from dopslam_ros.core.pmb.records import (
    Associations,
    Conditioned,
    Density,
    Newborn,
    Observed,
    Outcome,
    Ranked,
)
from dopslam_ros.core.pmb.undetected_kernels import looked_from
from dopslam_ros.core.pmb.update import condition
from dopslam_ros.core.settings.filtering import Constants
from dopslam_ros.core.settings.layout import NONE


@from_python
def learn(
    weighed: Density,
    prior: Density,
    births: bool,
    observed: Observed,
    speed: float,
    constants: Constants,
) -> Outcome:
    """The step of the PMB in one call: arrays that stay inside need not be made Python's.

    Args:
        weighed: the predicted density that says how the paths may go, and where to linearise.
        prior: the one that is updated: the same, or one with the vehicle somewhere else.
        births: whether there may be new landmarks.
        observed: the paths.
        speed: v at the snapshot [m/s].
        constants: of the filter.
    """
    ranked = rank(weighed, observed, speed, constants)
    if not births:
        none = Newborn(ranked.born.existence, np.zeros(len(observed.values), np.bool_))
        ranked = Ranked(
            ranked.evidence, ranked.births, ranked.weights, ranked.hypotheses, none, ranked.sound
        )
    conditioned = continued(prior, ranked, ranked.born.kept, observed, constants)
    after, leaving = conclude(ranked.hypotheses.weight, conditioned, constants)
    named = name(
        conditioned.density.track_id,
        ranked,
        conditioned.birth_track,
        conditioned.updated.nis[0],
        observed,
    )
    return Outcome(after, leaving, named, ranked.sound and conditioned.updated.sound)


@jit
def rank(density: Density, observed: Observed, speed: float, constants: Constants) -> Ranked:
    """Weighs the paths against a predicted density and finds the best associations."""
    evidence, sound = weigh(density, observed, speed, constants)
    births = propose(density, observed, speed, constants)
    weights = weigh_locally(density, observed, evidence, births, constants)
    best = associate(density.component_track, weights, constants.gamma)
    born = newborn(births.log_intensity, weights.new, best, constants.prune_existence)
    sound = sound and math.isfinite(best.log_evidence)
    return Ranked(evidence, births, weights, best, born, sound)


@from_python
def continued(
    density: Density,
    ranked: Ranked,
    numbered: BoolArray,
    observed: Observed,
    constants: Constants,
) -> Conditioned:
    """Updates a density with each of its associations; ``numbered`` (J,) births get an id."""
    augmented, birth_track = augment(density, ranked.births, ranked.born, numbered, constants)
    source = ranked.hypotheses.source
    updated = condition(augmented.mean, augmented.covariance, ranked.evidence, observed, source)
    existence, type_weight = judge(augmented, ranked.evidence.detection, birth_track, source)
    return Conditioned(augmented, birth_track, updated, existence, type_weight)


@from_python
def conclude(
    weight: FloatArray, conditioned: Conditioned, constants: Constants
) -> tuple[Density, bool]:
    """A posterior density made ready for the next step.

    Args:
        weight: (H,) of the associations.
        conditioned: the density under each.
        constants: what is pruned and seen.

    Returns:
        The density, and whether scattering points were left behind.
    """
    merged = merge(weight, conditioned, constants)
    mean = merged.mean
    mean[2] = wrapped(mean[2])
    undetected = looked_from(merged.undetected, mean[0], mean[1], constants.sight)
    after = Density(
        mean,
        merged.covariance,
        merged.start,
        merged.origin,
        merged.axes,
        merged.component_track,
        merged.component_type,
        merged.component_weight,
        merged.track_id,
        merged.existence,
        undetected,
        merged.next_id,
    )
    return after, some_left_behind(after, constants.sight)


@jit
def name(
    track_id: IntArray,
    ranked: Ranked,
    birth_track: IntArray,
    nis: float,
    observed: Observed,
) -> Associations:
    """The associations in terms of landmark ids.

    Args:
        track_id: (T,) those of the density come first, then the births.
        ranked: the associations.
        birth_track: (J,) track born from each path, or NONE.
        nis: of the likeliest.
        observed: the paths.
    """
    best, weights = ranked.hypotheses, ranked.weights
    rows, paths = best.track.shape
    ids, born, dof = np.empty((rows, paths), np.int64), np.empty(paths, np.int64), 0
    for j in range(paths):
        born[j] = track_id[birth_track[j]] if birth_track[j] != NONE else NONE
        for h in range(rows):
            track = best.track[h, j]
            ids[h, j] = track_id[track - 1] if track > 0 else track  # the BS is 0 as well
        if rows > 0 and best.track[0, j] != NONE:
            for k in range(observed.used.shape[1]):
                dof += observed.used[j, k]
    sources = np.zeros(len(weights.missed), np.int64)
    for row in range(1, len(sources)):
        sources[row] = track_id[row - 1]
    return Associations(
        ids,
        best.weight,
        born,
        nis,
        dof,
        best.log_evidence,
        sources,
        weights.missed,
        weights.new,
    )
