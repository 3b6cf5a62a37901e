"""The poses that a lost vehicle may have, each with a filter that goes on from there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dopslam_ros.core.models.measurements import MeasurementSet
from dopslam_ros.core.models.motion import ControlSpan
from dopslam_ros.core.monitoring.pose_problem import Clock
from dopslam_ros.core.monitoring.pose_search import fixes, same_pose
from dopslam_ros.core.pmb import FilterParameters, Mixture, MixtureStep, mixture_step
from dopslam_ros.core.pmb.step import predict
from dopslam_ros.core.settings.layout import CLOCK_BIAS

# ln of the odds at which a pose is not worth to be carried on.
HOPELESS = 30.0
# Poses carried on at the same time.
MOST_CANDIDATES = 6
# ln of the probability that the vehicle is where dead reckoning says after all.
LOG_RECKONED = float(np.log(0.1))
# The clock goes on when the vehicle is lost, but not to be trusted as before.
CLOCK_FACTOR, CLOCK_STD = 3.0, 3.0


@dataclass(frozen=True)
class Candidate:
    """A pose that the vehicle may have, with a filter that goes on from there.

    Attributes:
        outcome: of the filter's last step.
        log_weight: ln of the probability of all sets since, and of the pose.
    """

    outcome: MixtureStep
    log_weight: float


@dataclass(frozen=True)
class Lost:
    """What is known of a vehicle that is lost.

    Attributes:
        reckoned: the last accepted density, the vehicle moved on by dead reckoning.
        trusted: whether the vehicle may be where that says.
        candidates: poses it may have.
        log_nothing: ln of the probability of all sets since if none of the candidates is right.
        sets: how many there were.
    """

    reckoned: Mixture
    trusted: bool
    candidates: tuple[Candidate, ...] = ()
    log_nothing: float = 0.0
    sets: int = 0


def carried_on(
    lost: Lost,
    measurements: MeasurementSet,
    spans: Sequence[ControlSpan],
    speed: float,
    parameters: FilterParameters,
) -> list[Candidate]:
    """The candidates after one more set; those that cannot go on are left out."""
    found: list[Candidate] = []
    for one in lost.candidates:
        try:
            outcome = mixture_step(one.outcome.state, measurements, spans, speed, parameters)
        except np.linalg.LinAlgError:
            continue
        weight = one.log_weight + outcome.associations.log_evidence
        found.append(Candidate(outcome, weight))
    return found


def moved_on(
    lost: Lost, spans: Sequence[ControlSpan], parameters: FilterParameters
) -> tuple[Candidate, ...]:
    """The candidates after a set without paths: moved on by dead reckoning."""
    return tuple(
        Candidate(
            replace(one.outcome, state=dead_reckoned(one.outcome.state, spans, parameters)),
            one.log_weight,
        )
        for one in lost.candidates
    )


def proposed(
    lost: Lost,
    reckoned: Mixture,
    measurements: MeasurementSet,
    speed: float,
    parameters: FilterParameters,
) -> list[Candidate]:
    """New candidates: what the set says, and the pose by dead reckoning."""
    found: list[Candidate] = []
    base = reckoned.best
    std = CLOCK_FACTOR * float(np.sqrt(base.ue_covariance[CLOCK_BIAS, CLOCK_BIAS]))
    clock = Clock(float(base.ue_mean[CLOCK_BIAS]), max(std, CLOCK_STD))
    for fix in fixes(base, measurements, speed, clock, parameters):
        outcome = MixtureStep(Mixture((fix.step.state,), np.ones(1)), fix.step.associations)
        found.append(Candidate(outcome, lost.log_nothing + fix.log_evidence))
    if lost.trusted:
        try:
            outcome = mixture_step(reckoned, measurements, (), speed, parameters)
        except np.linalg.LinAlgError:
            return found
        weight = lost.log_nothing + LOG_RECKONED + outcome.associations.log_evidence
        found.append(Candidate(outcome, weight))
    return found


def worth_keeping(candidates: Sequence[Candidate], nothing: float) -> tuple[Candidate, ...]:
    """The likeliest candidates with different poses."""
    kept: list[Candidate] = []
    order = sorted(candidates, key=lambda one: -one.log_weight)
    for one in order:
        if len(kept) == MOST_CANDIDATES or not one.log_weight > nothing - HOPELESS:
            break
        if one.log_weight > order[0].log_weight - HOPELESS and not any(
            _same(one.outcome.state, other.outcome.state) for other in kept
        ):
            kept.append(one)
    return tuple(kept)


def _same(one: Mixture, other: Mixture) -> bool:
    covariance = one.ue_covariance + other.ue_covariance
    return same_pose(one.ue_mean.copy(), other.ue_mean, covariance)


def dead_reckoned(
    state: Mixture, spans: Sequence[ControlSpan], parameters: FilterParameters
) -> Mixture:
    """Dead reckoning: the vehicle moved on by the controls, the map as it was."""
    moved = tuple(predict(one, spans, parameters) for one in state.hypotheses)
    return replace(state, hypotheses=moved)
