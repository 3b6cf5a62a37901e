"""The step: associate the paths, update under each association, merge."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dopslam_ros.core.linalg.arrays import BoolArray, FloatArray, IntArray
from dopslam_ros.core.linalg.jit import from_python, jit
from dopslam_ros.core.models.channel_kernels import wrapped
from dopslam_ros.core.pmb.birth import Births, propose
from dopslam_ros.core.pmb.density import Density
from dopslam_ros.core.pmb.hypotheses import Hypotheses, LocalWeights, associate, local_weights
from dopslam_ros.core.pmb.inactive_kernels import some_left_behind
from dopslam_ros.core.pmb.likelihood import Likelihoods, Observed, local_likelihoods
from dopslam_ros.core.pmb.merge import Conditioned, existence_and_types, merge
from dopslam_ros.core.pmb.newborn import Newborn, augment, newborn
from dopslam_ros.core.pmb.undetected import looked_from
from dopslam_ros.core.pmb.update import Linearised, condition
from dopslam_ros.core.settings.filtering import Constants
from dopslam_ros.core.settings.layout import HEADING, NONE, X, Y


@from_python
def slam(
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
    association = associate_paths(weighed, observed, speed, constants)
    if not births:
        none = Newborn(association.born.existence, np.zeros(len(observed.values), np.bool_))
        association = DataAssociation(
            association.likelihoods,
            association.births,
            association.weights,
            association.hypotheses,
            none,
            association.definite,
        )
    conditioned = condition_on(prior, association, association.born.kept, observed, constants)
    after, leaving = posterior(association.hypotheses.weight, conditioned, constants)
    named = by_landmark_id(
        conditioned.density.track_id,
        association,
        conditioned.birth_track,
        conditioned.updated.nis[0],
        observed,
    )
    return Outcome(after, leaving, named, association.definite and conditioned.updated.definite)


@jit
def associate_paths(
    density: Density, observed: Observed, speed: float, constants: Constants
) -> DataAssociation:
    """Weighs the paths against a predicted density and finds the best associations."""
    likelihoods, definite = local_likelihoods(density, observed, speed, constants)
    births = propose(density, observed, speed, constants)
    weights = local_weights(density, observed, likelihoods, births, constants)
    best = associate(density.component_track, weights, constants.gamma)
    born = newborn(births.log_intensity, weights.new, best, constants.prune_existence)
    definite = definite and math.isfinite(best.log_evidence)
    return DataAssociation(likelihoods, births, weights, best, born, definite)


@from_python
def condition_on(
    density: Density,
    association: DataAssociation,
    numbered: BoolArray,
    observed: Observed,
    constants: Constants,
) -> Conditioned:
    """Updates a density with each of its associations; ``numbered`` (J,) births get an id."""
    augmented, birth_track = augment(
        density, association.births, association.born, numbered, constants
    )
    source = association.hypotheses.source
    about = Linearised(
        augmented.mean, augmented.vehicle, augmented.start, association.likelihoods, observed
    )
    updated = condition(about, augmented.covariance, source)
    existence, type_weight = existence_and_types(
        augmented, association.likelihoods.detection, birth_track, source
    )
    return Conditioned(augmented, birth_track, updated, existence, type_weight)


@from_python
def posterior(
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
    mean[HEADING] = wrapped(mean[HEADING])
    undetected = looked_from(merged.undetected, mean[X], mean[Y], constants.sp_field_of_view)
    after = Density(
        mean,
        merged.covariance,
        merged.vehicle,
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
def by_landmark_id(
    track_id: IntArray,
    association: DataAssociation,
    birth_track: IntArray,
    nis: float,
    observed: Observed,
) -> Associations:
    """The associations in terms of landmark ids.

    Args:
        track_id: (T,) those of the density come first, then the births.
        association: of the paths with the density.
        birth_track: (J,) track born from each path, or NONE.
        nis: of the likeliest.
        observed: the paths.
    """
    best, weights = association.hypotheses, association.weights
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
        likelihoods: of every source.
        births: a candidate from every path.
        weights: of every pair.
        hypotheses: the best associations.
        born: births worth keeping.
        definite: whether every innovation's covariance was positive definite.
    """

    likelihoods: Likelihoods
    births: Births
    weights: LocalWeights
    hypotheses: Hypotheses
    born: Newborn
    definite: bool


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
        definite: whether every innovation's covariance was positive definite.
    """

    density: Density
    leaving: bool
    associations: Associations
    definite: bool
