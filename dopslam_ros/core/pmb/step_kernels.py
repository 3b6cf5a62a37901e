"""The step: rank the associations, update under each, conclude."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dopslam_ros.core.linalg.arrays import BoolArray, FloatArray, IntArray
from dopslam_ros.core.linalg.jit import from_python, jit
from dopslam_ros.core.models.channel_kernels import wrapped
from dopslam_ros.core.pmb.birth import Births, propose
from dopslam_ros.core.pmb.density import Density
from dopslam_ros.core.pmb.hypotheses import Hypotheses, LocalWeights, associate, weigh_locally
from dopslam_ros.core.pmb.inactive_kernels import some_left_behind
from dopslam_ros.core.pmb.likelihood import Likelihoods, Observed, weigh
from dopslam_ros.core.pmb.merge import Conditioned, existence_and_types, merge
from dopslam_ros.core.pmb.newborn import Newborn, augment, newborn
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
        ranked = DataAssociation(
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
def rank(
    density: Density, observed: Observed, speed: float, constants: Constants
) -> DataAssociation:
    """Weighs the paths against a predicted density and finds the best associations."""
    evidence, sound = weigh(density, observed, speed, constants)
    births = propose(density, observed, speed, constants)
    weights = weigh_locally(density, observed, evidence, births, constants)
    best = associate(density.component_track, weights, constants.gamma)
    born = newborn(births.log_intensity, weights.new, best, constants.prune_existence)
    sound = sound and math.isfinite(best.log_evidence)
    return DataAssociation(evidence, births, weights, best, born, sound)


@from_python
def continued(
    density: Density,
    ranked: DataAssociation,
    numbered: BoolArray,
    observed: Observed,
    constants: Constants,
) -> Conditioned:
    """Updates a density with each of its associations; ``numbered`` (J,) births get an id."""
    augmented, birth_track = augment(density, ranked.births, ranked.born, numbered, constants)
    source = ranked.hypotheses.source
    updated = condition(augmented.mean, augmented.covariance, ranked.evidence, observed, source)
    existence, type_weight = existence_and_types(
        augmented, ranked.evidence.detection, birth_track, source
    )
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
    undetected = looked_from(merged.undetected, mean[0], mean[1], constants.sp_field_of_view)
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
    return after, some_left_behind(after, constants.sp_field_of_view)


@jit
def name(
    track_id: IntArray,
    ranked: DataAssociation,
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


class DataAssociation(NamedTuple):
    """How the paths may go with a density.

    Attributes:
        evidence: of every source.
        births: a candidate from every path.
        weights: of every pair.
        hypotheses: the best associations.
        born: births worth keeping.
        sound: whether the arithmetic went well.
    """

    evidence: Likelihoods
    births: Births
    weights: LocalWeights
    hypotheses: Hypotheses
    born: Newborn
    sound: bool


class Associations(NamedTuple):
    """Which path came from where, in terms of landmark ids; for monitors and studies.

    Attributes:
        ids: (H, J) id of the landmark (0 the BS) each path was given to, or NONE.
        weight: (H,) normalised weights.
        born: (J,) id of the landmark born from each path, or NONE.
        nis: normalised innovation squared v' S^-1 v of all paths that the likeliest hypothesis
            gives to a landmark, jointly: S has their cross terms, v is in order of the update.
        nis_dof: how many numbers these paths have; nis is 0 where it is 0, chi-squared with so
            many degrees of freedom where filter, models and hypothesis are right.
        log_evidence: ln of the sum of the hypotheses' weights before normalisation, how well the
            set was foreseen: of all paths, clutter and misdetections included.
        sources: (S,) ids of what could have been heard, the BS first.
        log_missed: (S,) ln of the probability that it is not heard.
        log_new: (J,) ln of the intensity of clutter and new landmarks at each path.
    """

    ids: IntArray
    weight: FloatArray
    born: IntArray
    nis: float
    nis_dof: int
    log_evidence: float
    sources: IntArray
    log_missed: FloatArray
    log_new: FloatArray


class Outcome(NamedTuple):
    """What a step leads to.

    Attributes:
        density: posterior.
        leaving: whether scattering points were left behind.
        associations: the hypotheses it was merged from.
        sound: whether the arithmetic went well.
    """

    density: Density
    leaving: bool
    associations: Associations
    sound: bool
