"""One step of the EK-PMB filter: predict, weigh, associate, update, merge, prune."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dopslam_ros.core.arrays import BoolArray, FloatArray, IntArray, wrap_angle
from dopslam_ros.core.assignment import UNASSIGNED
from dopslam_ros.core.filter import birth, evidence, hypotheses, update
from dopslam_ros.core.filter.asleep import fall_asleep, wake_up
from dopslam_ros.core.filter.localise import localised
from dopslam_ros.core.filter.state import UE, FilterParameters, FilterState
from dopslam_ros.core.filter.undetected import looked_from
from dopslam_ros.core.measurements import MeasurementSet
from dopslam_ros.core.motion import ControlSpan, predict_covariance, propagate_spans

# Row 0 of the association problem is the BS, whose id is 0 as well.
BS_ID = 0


@dataclass(frozen=True)
class Associations:
    """Which path came from where, in terms of landmark ids; for monitors and studies.

    Attributes:
        ids: (H, J) id of the landmark (0 the BS) each path was given to, or UNASSIGNED.
        weight: (H,) normalised weights.
        born: (J,) id of the landmark born from each path, or UNASSIGNED.
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


@dataclass(frozen=True)
class Step:
    """The outcome of a step.

    Attributes:
        state: posterior density.
        associations: the hypotheses it was merged from.
    """

    state: FilterState
    associations: Associations


def step(
    state: FilterState,
    measurements: MeasurementSet,
    spans: Sequence[ControlSpan],
    speed: float,
    parameters: FilterParameters,
) -> Step:
    """p(s, X | Z_1:k-1) to p(s, X | Z_1:k), Section IV-B.

    Args:
        state: density after the previous snapshot.
        measurements: the snapshot.
        spans: controls since the previous snapshot; empty for the first one.
        speed: v at the snapshot [m/s].
        parameters: models and settings.
    """
    observed = evidence.prepare(measurements, parameters)
    ranked = rank(advance(state, spans, parameters), observed, speed, parameters)
    return posterior(ranked, observed, parameters)


def posterior(ranked: Ranked, observed: evidence.Observed, parameters: FilterParameters) -> Step:
    """The second half of a step: what follows from the associations."""
    if not parameters.mapping:
        return _localise(ranked, observed, parameters)
    conditioned = condition(ranked, ranked.born.kept, observed, parameters)
    merged = update.merge(
        conditioned.augmented, conditioned.outcomes, ranked.hypotheses, parameters
    )
    return Step(state=finish(merged, parameters), associations=associations_of(ranked, conditioned))


@dataclass(frozen=True)
class Ranked:
    """A density and how the paths may go with it.

    Attributes:
        predicted: the density the paths are weighed against.
        evidence: of every source.
        births: a candidate from every path.
        weights: of every pair.
        hypotheses: the best associations.
        born: births worth keeping.
    """

    predicted: FilterState
    evidence: evidence.Evidence
    births: birth.Births
    weights: hypotheses.LocalWeights
    hypotheses: hypotheses.Hypotheses
    born: update.Newborn


@dataclass(frozen=True)
class Conditioned:
    """A density given each of its H associations.

    Attributes:
        augmented: with the births.
        outcomes: existence and types.
        nis: of the likeliest of them, see Associations.
        nis_dof: of the same.
    """

    augmented: update.Augmented
    outcomes: update.Outcomes
    nis: float
    nis_dof: int


def rank(
    predicted: FilterState,
    observed: evidence.Observed,
    speed: float,
    parameters: FilterParameters,
) -> Ranked:
    """Weighs the paths against a predicted density and finds the best associations."""
    fit = evidence.weigh(predicted, observed, speed, parameters)
    births = birth.propose(predicted, observed, speed, parameters)
    weights = hypotheses.local_weights(predicted, observed, fit, births, parameters)
    best = hypotheses.associate(predicted, weights, parameters)
    born = update.newborn(births, weights, best, parameters)
    return Ranked(predicted, fit, births, weights, best, born)


def condition(
    ranked: Ranked,
    numbered: BoolArray,
    observed: evidence.Observed,
    parameters: FilterParameters,
) -> Conditioned:
    """Updates a density with each of its associations; ``numbered`` (J,) births get an id."""
    updated = update.condition(ranked.predicted, observed, ranked.evidence, ranked.hypotheses)
    augmented = update.augment(
        ranked.predicted,
        updated.means,
        updated.covariances,
        ranked.births,
        ranked.born,
        numbered,
        parameters,
    )
    outcomes = update.judge(augmented, ranked.evidence, ranked.hypotheses)
    return Conditioned(augmented, outcomes, *_fit(updated, ranked.hypotheses, observed))


def _fit(
    updated: update.Updated, best: hypotheses.Hypotheses, observed: evidence.Observed
) -> tuple[float, int]:
    """The normalised innovation squared of the likeliest hypothesis and what it counts."""
    return float(updated.nis[0]), int(observed.used[best.source[0] != UNASSIGNED].sum())


def _localise(ranked: Ranked, observed: evidence.Observed, parameters: FilterParameters) -> Step:
    """The step on a known map: what is not of it is clutter or new, and of no interest."""
    predicted, best = ranked.predicted, ranked.hypotheses
    updated = update.condition(predicted, observed, ranked.evidence, best)
    state = localised(predicted, updated.means, updated.covariances, best.weight, parameters)
    nothing_born = np.full(len(observed.values), UNASSIGNED)
    fit = _fit(updated, best, observed)
    return Step(state, _associations(predicted, ranked, nothing_born, *fit))


def finish(state: FilterState, parameters: FilterParameters) -> FilterState:
    """A posterior density made ready for the next step."""
    pruned = update.prune(state, parameters)
    mean = pruned.mean.copy()
    mean[2] = wrap_angle(mean[2])
    looked = looked_from(state.undetected, mean[:2], parameters)
    return fall_asleep(replace(pruned, mean=mean, undetected=looked), parameters)


def advance(
    state: FilterState, spans: Sequence[ControlSpan], parameters: FilterParameters
) -> FilterState:
    """The density that the next set is weighed against: predicted, what may be seen awake."""
    return wake_up(predict(state, spans, parameters), parameters)


def predict(
    state: FilterState, spans: Sequence[ControlSpan], parameters: FilterParameters
) -> FilterState:
    """The vehicle moves by f with F P F' + Q; the map is static, its correlation follows F."""
    if not spans:
        return state
    ue, jacobian, noise = propagate_spans(state.ue_mean, spans, parameters.noise_rate)
    mean = np.concatenate([ue, state.mean[UE:]])
    covariance = predict_covariance(state.covariance, jacobian, noise)
    return replace(state, mean=mean, covariance=covariance)


def associations_of(ranked: Ranked, conditioned: Conditioned) -> Associations:
    """The associations in terms of landmark ids."""
    augmented = conditioned.augmented
    born = np.concatenate([augmented.state.track_id, [UNASSIGNED]])[augmented.birth_track]
    return _associations(augmented.state, ranked, born, conditioned.nis, conditioned.nis_dof)


def _associations(
    state: FilterState, ranked: Ranked, born: IntArray, nis: float, nis_dof: int
) -> Associations:
    best, weights = ranked.hypotheses, ranked.weights
    row_ids = np.concatenate([[BS_ID], state.track_id, [UNASSIGNED]])  # UNASSIGNED is the last one
    return Associations(
        ids=row_ids[best.track],
        weight=best.weight,
        born=born,
        nis=nis,
        nis_dof=nis_dof,
        log_evidence=best.log_evidence,
        sources=row_ids[: len(weights.missed)],
        log_missed=weights.missed,
        log_new=weights.new,
    )
