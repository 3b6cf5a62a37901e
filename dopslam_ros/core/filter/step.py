"""One step of the EK-PMB filter: predict, weigh, associate, update, merge, prune."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dopslam_ros.core.arrays import FloatArray, IntArray, wrap_angle
from dopslam_ros.core.assignment import UNASSIGNED
from dopslam_ros.core.channel import LandmarkType
from dopslam_ros.core.filter import birth, evidence, hypotheses, update
from dopslam_ros.core.filter.state import UE, UNKNOWN_TYPES, FilterParameters, FilterState
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
    """

    ids: IntArray
    weight: FloatArray
    born: IntArray


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
    predicted = predict(state, spans, parameters)
    observed = evidence.prepare(measurements, parameters)
    fit = evidence.weigh(predicted, observed, speed, parameters)
    births = birth.propose(predicted, observed, speed, parameters)
    weights = hypotheses.local_weights(predicted, observed, fit, births, parameters)
    ranked = hypotheses.associate(predicted, weights, parameters)
    augmented = update.augment(predicted, births, weights, ranked, parameters)
    means, covariances = update.condition(augmented, observed, fit, ranked)
    outcomes = update.judge(augmented, fit, ranked)
    merged = update.merge(augmented, means, covariances, outcomes, ranked, parameters)
    merged = undetected_after_miss(merged, parameters)
    return Step(
        state=_wrapped(update.prune(merged, parameters)),
        associations=_associations(augmented, ranked),
    )


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


def undetected_after_miss(state: FilterState, parameters: FilterParameters) -> FilterState:
    """lambda <- (1 - p_D) lambda where a detection was possible.

    VAs are in view from everywhere, so each snapshot thins out those never detected, down to a
    floor. SPs are not: the field of view moves on, and in what it has not covered yet the intensity
    is what it was, so theirs stays.
    """
    floor = parameters.undetected_floor * parameters.undetected_intensity
    always_seen = np.array(UNKNOWN_TYPES) == LandmarkType.VA
    thinned = np.maximum(state.undetected * (1.0 - parameters.detection_probability), floor)
    return replace(state, undetected=np.where(always_seen, thinned, state.undetected))


def _wrapped(state: FilterState) -> FilterState:
    mean = state.mean.copy()
    mean[2] = wrap_angle(mean[2])
    return replace(state, mean=mean)


def _associations(augmented: update.Augmented, ranked: hypotheses.Hypotheses) -> Associations:
    ids = augmented.state.track_id
    row_ids = np.concatenate([[BS_ID], ids, [UNASSIGNED]])  # UNASSIGNED is the last one
    born = np.concatenate([ids, [UNASSIGNED]])[augmented.birth_track]
    return Associations(ids=row_ids[ranked.track], weight=ranked.weight, born=born)
