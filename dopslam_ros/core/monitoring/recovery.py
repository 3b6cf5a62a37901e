"""The filter's step under watch: a vehicle that is lost is noticed and found again.

While all is well this is the filter's step and a look at its health. Once the doubts are too many,
the density goes back to the last one that was beyond doubt, and its map is touched no more. Each
set then proposes places (see ``relocalise``); every one is carried on as a filter of its own, and
the weights of all, together with those of "as reckoned from the controls" and "none of these", are
the probabilities of the sets since. When one place is beyond doubt, its filter goes on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import logsumexp

from dopslam_ros.core.models.measurements import MeasurementSet
from dopslam_ros.core.models.motion import ControlSpan
from dopslam_ros.core.monitoring.health import HEALTHY, Health, Level, judge, statistics_of
from dopslam_ros.core.monitoring.pose_search import (
    ANYWHERE,
    Clock,
    fixes,
    log_lost,
    placed,
    same_place,
)
from dopslam_ros.core.pmb import Associations, FilterParameters, Mixture, MixtureStep, mixture_step
from dopslam_ros.core.pmb.step import predict
from dopslam_ros.core.settings.layout import BS_ID, CLOCK_BIAS, NONE

# ln of the odds at which a place is beyond doubt, or not worth to be carried on.
SURE, HOPELESS = 9.0, 30.0
# Places carried on at the same time.
MOST_CANDIDATES = 6
# ln of the probability that the vehicle is where the controls say after all.
LOG_RECKONED = float(np.log(0.1))
# The clock goes on when the vehicle is lost, but not to be trusted as before.
CLOCK_FACTOR, CLOCK_STD = 3.0, 3.0


@dataclass(frozen=True)
class Candidate:
    """A place where the vehicle may be, with a filter that goes on from there.

    Attributes:
        outcome: of the filter's last step.
        log_weight: ln of the probability of all sets since, and of the place.
    """

    outcome: MixtureStep
    log_weight: float


@dataclass(frozen=True)
class Lost:
    """What is known of a vehicle that is lost.

    Attributes:
        reckoned: the last density beyond doubt, the vehicle moved on by the controls.
        trusted: whether the vehicle may be where they say.
        candidates: where it may be.
        log_nothing: ln of the probability of all sets since if none of the candidates is right.
        sets: how many there were.
    """

    reckoned: Mixture
    trusted: bool
    candidates: tuple[Candidate, ...] = ()
    log_nothing: float = 0.0
    sets: int = 0


@dataclass(frozen=True)
class Monitor:
    """What is remembered beside the density.

    Attributes:
        state: the density that belongs to it.
        health: after the last step.
        sound: the last density beyond doubt, the vehicle moved on by the controls.
        lost: set while the vehicle is lost.
    """

    state: Mixture
    health: Health
    sound: Mixture
    lost: Lost | None = None


def monitor_of(state: Mixture) -> Monitor:
    """The watch over a density that is taken to be right."""
    return Monitor(state, HEALTHY, state)


def without_pose(state: Mixture) -> Monitor:
    """The watch over a map in which the vehicle may be anywhere."""
    best = state.best
    nowhere = Mixture((placed(best, best.ue_mean, np.diag(np.square(ANYWHERE))),), np.ones(1))
    reason = "lost: no pose given, to be found from the first sets"
    health = Health(Level.LOST, reason, losses=1)
    return Monitor(nowhere, health, nowhere, Lost(nowhere, trusted=False))


def monitor_anew(state: Mixture, first: bool, parameters: FilterParameters) -> Monitor:
    """The watch over a density that was put in the place of another.

    Args:
        state: the density; that of a vehicle that is lost says itself that it may be anywhere.
        first: whether it is a start, of which the parameters say whether the pose is known.
        parameters: of the filter.
    """
    unknown = first and parameters.initial_pose == "unknown"
    anywhere = state.ue_covariance[0, 0] > 0.5 * ANYWHERE[0] ** 2
    return without_pose(state) if unknown or anywhere else monitor_of(state)


def monitored_step(
    watch: Monitor,
    measurements: MeasurementSet,
    spans: Sequence[ControlSpan],
    speed: float,
    parameters: FilterParameters,
) -> tuple[Monitor, MixtureStep]:
    """A step of the filter, or of the search for the vehicle.

    Args:
        watch: after the step before.
        measurements: the snapshot.
        spans: controls since the previous snapshot.
        speed: v at the snapshot [m/s].
        parameters: models and settings.

    Raises:
        LinAlgError: the numbers allow no answer.
    """
    if watch.lost is not None:
        return _searched(watch, watch.lost, measurements, spans, speed, parameters)
    outcome = mixture_step(watch.state, measurements, spans, speed, parameters)
    weighed = outcome
    if watch.health.cusum > 0.0:  # against what was expected before there was any doubt
        weighed = mixture_step(watch.sound, measurements, spans, speed, parameters)
    signs = statistics_of(weighed.associations, measurements, parameters)
    covariance = outcome.state.ue_covariance
    health = judge(watch.health, signs, outcome.associations, covariance, parameters)
    if health.level == Level.LOST:
        return _searched(
            replace(watch, health=health),
            Lost(watch.sound, trusted=True),
            measurements,
            spans,
            speed,
            parameters,
        )
    doubted = health.cusum > 0.0
    sound = _moved(watch.sound, spans, parameters) if doubted else outcome.state
    return Monitor(outcome.state, health, sound), outcome


def _searched(
    watch: Monitor,
    lost: Lost,
    measurements: MeasurementSet,
    spans: Sequence[ControlSpan],
    speed: float,
    parameters: FilterParameters,
) -> tuple[Monitor, MixtureStep]:
    """A step of the search."""
    reckoned = _moved(lost.reckoned, spans, parameters)
    if not len(measurements):
        moved = tuple(
            replace(
                one,
                outcome=replace(one.outcome, state=_moved(one.outcome.state, spans, parameters)),
            )
            for one in lost.candidates
        )
        lost = replace(lost, reckoned=reckoned, candidates=moved, sets=lost.sets + 1)
        return _still_lost(watch, lost, measurements)
    candidates = [
        *_carried_on(lost, measurements, spans, speed, parameters),
        *_proposed(lost, reckoned, measurements, speed, parameters),
    ]
    nothing = lost.log_nothing + log_lost(measurements, parameters)
    kept = _worth_keeping(candidates, nothing)
    lost = Lost(reckoned, lost.trusted, kept, nothing, lost.sets + 1)
    if kept and _beyond_doubt(kept, nothing):
        outcome = kept[0].outcome
        reason = f"found again after {lost.sets} sets"
        health = Health(Level.WARN, reason, losses=watch.health.losses)
        return Monitor(outcome.state, health, outcome.state), outcome
    return _still_lost(watch, lost, measurements)


def _carried_on(
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


def _proposed(
    lost: Lost,
    reckoned: Mixture,
    measurements: MeasurementSet,
    speed: float,
    parameters: FilterParameters,
) -> list[Candidate]:
    """New candidates: what the set says, and where the controls say the vehicle is."""
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


def _worth_keeping(candidates: Sequence[Candidate], nothing: float) -> tuple[Candidate, ...]:
    """The likeliest candidates at different places."""
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
    return same_place(one.ue_mean.copy(), other.ue_mean, covariance)


def _beyond_doubt(candidates: Sequence[Candidate], nothing: float) -> bool:
    others = logsumexp([nothing, *(one.log_weight for one in candidates[1:])])
    return bool(candidates[0].log_weight - others > SURE)


def _still_lost(
    watch: Monitor, lost: Lost, measurements: MeasurementSet
) -> tuple[Monitor, MixtureStep]:
    """What is reported of a lost vehicle: the likeliest place, and that it may be anywhere."""
    base = lost.reckoned.best
    place = lost.candidates[0].outcome.state if lost.candidates else lost.reckoned
    state = Mixture(
        (placed(base, place.ue_mean, np.diag(np.square(ANYWHERE))),),
        np.ones(1),
    )
    searched = f"searched in {lost.sets} sets, {len(lost.candidates)} places possible"
    reason = watch.health.reason.partition(";")[0]
    health = replace(watch.health, level=Level.LOST, reason=f"{reason}; {searched}")
    associations = _nothing_known(measurements, lost.log_nothing)
    return Monitor(state, health, lost.reckoned, lost), MixtureStep(state, associations)


def _nothing_known(measurements: MeasurementSet, log_evidence: float) -> Associations:
    """No path was given to anything."""
    nobody = np.full(len(measurements), NONE)
    return Associations(
        ids=nobody[None],
        weight=np.ones(1),
        born=nobody,
        nis=0.0,
        nis_dof=0,
        log_evidence=log_evidence,
        sources=np.array([BS_ID]),
        log_missed=np.zeros(1),
        log_new=np.zeros(len(measurements)),
    )


def _moved(state: Mixture, spans: Sequence[ControlSpan], parameters: FilterParameters) -> Mixture:
    """The vehicle moved on by the controls, the map as it was."""
    moved = tuple(predict(one, spans, parameters) for one in state.hypotheses)
    return replace(state, hypotheses=moved)
