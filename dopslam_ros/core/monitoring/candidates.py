"""The poses that a lost vehicle may have, each with a filter that goes on from there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dopslam_ros.core.models.motion import ControlSpan
from dopslam_ros.core.monitoring.pose_problem import Clock
from dopslam_ros.core.monitoring.pose_search import fixes, same_pose
from dopslam_ros.core.pmb import Associations, FilterParameters, Posterior, step
from dopslam_ros.core.pmb.likelihood import Observed
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
        posterior: after the filter's last step.
        associations: of that step.
        log_weight: ln of the probability of all sets since, and of the pose.
    """

    posterior: Posterior
    associations: Associations
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

    reckoned: Posterior
    trusted: bool
    candidates: tuple[Candidate, ...] = ()
    log_nothing: float = 0.0
    sets: int = 0


def carried_on(
    lost: Lost,
    observed: Observed,
    spans: Sequence[ControlSpan],
    speed: float,
    parameters: FilterParameters,
) -> list[Candidate]:
    """The candidates after one more set; those that cannot go on are left out."""
    found: list[Candidate] = []
    for one in lost.candidates:
        try:
            posterior, associations = step(one.posterior, observed, spans, speed, parameters)
        except np.linalg.LinAlgError:
            continue
        weight = one.log_weight + associations.log_evidence
        found.append(Candidate(posterior, associations, weight))
    return found


def moved_on(
    lost: Lost, spans: Sequence[ControlSpan], parameters: FilterParameters
) -> tuple[Candidate, ...]:
    """The candidates after a set without paths: moved on by dead reckoning."""
    return tuple(
        replace(one, posterior=predict(one.posterior, spans, parameters)) for one in lost.candidates
    )


def proposed(
    lost: Lost,
    reckoned: Posterior,
    observed: Observed,
    speed: float,
    parameters: FilterParameters,
) -> list[Candidate]:
    """New candidates: what the set says, and the pose by dead reckoning."""
    found: list[Candidate] = []
    vehicle = reckoned.density
    std = CLOCK_FACTOR * float(np.sqrt(vehicle.ue_covariance[CLOCK_BIAS, CLOCK_BIAS]))
    clock = Clock(float(vehicle.ue_mean[CLOCK_BIAS]), max(std, CLOCK_STD))
    for fix in fixes(reckoned, observed, speed, clock, parameters):
        weight = lost.log_nothing + fix.log_evidence
        found.append(Candidate(fix.posterior, fix.associations, weight))
    if lost.trusted:
        try:
            posterior, associations = step(reckoned, observed, (), speed, parameters)
        except np.linalg.LinAlgError:
            return found
        weight = lost.log_nothing + LOG_RECKONED + associations.log_evidence
        found.append(Candidate(posterior, associations, weight))
    return found


def worth_keeping(candidates: Sequence[Candidate], nothing: float) -> tuple[Candidate, ...]:
    """The likeliest candidates with different poses."""
    kept: list[Candidate] = []
    order = sorted(candidates, key=lambda one: -one.log_weight)
    for one in order:
        if len(kept) == MOST_CANDIDATES or not one.log_weight > nothing - HOPELESS:
            break
        if one.log_weight > order[0].log_weight - HOPELESS and not any(
            _same(one.posterior, other.posterior) for other in kept
        ):
            kept.append(one)
    return tuple(kept)


def _same(one: Posterior, other: Posterior) -> bool:
    covariance = one.ue_covariance + other.ue_covariance
    return same_pose(one.ue_mean.copy(), other.ue_mean, covariance)
