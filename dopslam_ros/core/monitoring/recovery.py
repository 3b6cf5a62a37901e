"""The monitored step of the filter: a vehicle that is lost is noticed and found again.

While all is well this is the filter's step and a look at its health. Once the CUSUM is too large,
the density goes back to the last one that was accepted, and its map is touched no more. Each set
then proposes poses (see ``pose_search``); every one is carried on as a filter of its own, and the
weights of all, together with those of "by dead reckoning" and "none of these", are the
probabilities of the sets since. When one pose is sure, its filter goes on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import logsumexp

from dopslam_ros.core.linalg.arrays import FloatArray
from dopslam_ros.core.models.motion import ControlSpan
from dopslam_ros.core.monitoring.candidates import (
    Candidate,
    Lost,
    carried_on,
    moved_on,
    proposed,
    worth_keeping,
)
from dopslam_ros.core.monitoring.health import HEALTHY, Health, Level, assess, statistics_of
from dopslam_ros.core.monitoring.pose_problem import POSE
from dopslam_ros.core.monitoring.pose_search import ANYWHERE, log_lost, with_pose_unknown
from dopslam_ros.core.pmb import Associations, FilterParameters, Posterior, step
from dopslam_ros.core.pmb.likelihood import Observed
from dopslam_ros.core.pmb.posterior import posterior_of
from dopslam_ros.core.pmb.step import predict
from dopslam_ros.core.settings.layout import BS_ID, NONE, X

# ln of the odds at which a pose is sure.
SURE = 9.0


@dataclass(frozen=True)
class Monitor:
    """What is remembered beside the density.

    Attributes:
        state: the density that belongs to it.
        health: after the last step.
        accepted: the last density of a CUSUM of zero, the vehicle moved on by dead reckoning.
        lost: set while the vehicle is lost.
    """

    state: Posterior
    health: Health
    accepted: Posterior
    lost: Lost | None = None


def monitor_of(state: Posterior) -> Monitor:
    """The monitor of a density that is taken to be right."""
    return Monitor(state, HEALTHY, state)


def without_pose(state: Posterior) -> Monitor:
    """The monitor of a map in which the vehicle may be anywhere."""
    nowhere = _anywhere(state, state.density.ue_mean)
    reason = "lost: no pose given, to be found from the first sets"
    health = Health(Level.LOST, reason, losses=1)
    return Monitor(nowhere, health, nowhere, Lost(nowhere, trusted=False))


def monitor_anew(state: Posterior, first: bool, parameters: FilterParameters) -> Monitor:
    """The monitor of a density that replaces another.

    Args:
        state: the density; that of a vehicle that is lost says itself that it may be anywhere.
        first: whether it is a start, of which the parameters say whether the pose is known.
        parameters: of the filter.
    """
    unknown = first and parameters.initial_pose == "unknown"
    anywhere = state.ue_covariance[X, X] > 0.5 * ANYWHERE[X] ** 2
    return without_pose(state) if unknown or anywhere else monitor_of(state)


def monitored_step(
    monitor: Monitor,
    observed: Observed,
    spans: Sequence[ControlSpan],
    speed: float,
    parameters: FilterParameters,
) -> tuple[Monitor, Associations]:
    """A step of the filter, or of the search for the vehicle.

    Args:
        monitor: after the step before.
        observed: the snapshot.
        spans: controls since the previous snapshot.
        speed: v at the snapshot [m/s].
        parameters: models and settings.

    Raises:
        LinAlgError: the numbers allow no answer.
    """
    if monitor.lost is not None:
        return _searched(monitor, monitor.lost, observed, spans, speed, parameters)
    state, associations = step(monitor.state, observed, spans, speed, parameters)
    weighed = associations
    if monitor.health.cusum > 0.0:  # against what the accepted density expects
        _, weighed = step(monitor.accepted, observed, spans, speed, parameters)
    statistics = statistics_of(weighed, observed, parameters)
    health = assess(monitor.health, statistics, associations, state.ue_covariance, parameters)
    if health.level == Level.LOST:
        return _searched(
            replace(monitor, health=health),
            Lost(monitor.accepted, trusted=True),
            observed,
            spans,
            speed,
            parameters,
        )
    accepted = state
    if health.cusum > 0.0:
        accepted = predict(monitor.accepted, spans, parameters)
    return Monitor(state, health, accepted), associations


def _searched(
    monitor: Monitor,
    lost: Lost,
    observed: Observed,
    spans: Sequence[ControlSpan],
    speed: float,
    parameters: FilterParameters,
) -> tuple[Monitor, Associations]:
    """A step of the search."""
    reckoned = predict(lost.reckoned, spans, parameters)
    if not len(observed.values):
        moved = moved_on(lost, spans, parameters)
        lost = replace(lost, reckoned=reckoned, candidates=moved, sets=lost.sets + 1)
        return _still_lost(monitor, lost, observed)
    candidates = [
        *carried_on(lost, observed, spans, speed, parameters),
        *proposed(lost, reckoned, observed, speed, parameters),
    ]
    nothing = lost.log_nothing + log_lost(observed, parameters)
    kept = worth_keeping(candidates, nothing)
    lost = Lost(reckoned, lost.trusted, kept, nothing, lost.sets + 1)
    if kept and _sure(kept, nothing):
        found = kept[0]
        reason = f"found again after {lost.sets} sets"
        health = Health(Level.WARN, reason, losses=monitor.health.losses)
        return Monitor(found.posterior, health, found.posterior), found.associations
    return _still_lost(monitor, lost, observed)


def _sure(candidates: Sequence[Candidate], nothing: float) -> bool:
    others = logsumexp([nothing, *(one.log_weight for one in candidates[1:])])
    return bool(candidates[0].log_weight - others > SURE)


def _still_lost(monitor: Monitor, lost: Lost, observed: Observed) -> tuple[Monitor, Associations]:
    """What is reported of a lost vehicle: the likeliest pose, and that it may be anywhere."""
    likeliest = lost.candidates[0].posterior if lost.candidates else lost.reckoned
    state = _anywhere(lost.reckoned, likeliest.ue_mean)
    searched = f"searched in {lost.sets} sets, {len(lost.candidates)} places possible"
    reason = monitor.health.reason.partition(";")[0]
    health = replace(monitor.health, level=Level.LOST, reason=f"{reason}; {searched}")
    associations = _nothing_known(len(observed.values), lost.log_nothing)
    return Monitor(state, health, lost.reckoned, lost), associations


def _anywhere(state: Posterior, vehicle: FloatArray) -> Posterior:
    """The map of the likeliest hypothesis, the vehicle anywhere; nominally where (U,) says."""
    density = with_pose_unknown(state.density, vehicle[list(POSE)])
    return posterior_of(density, state.inactive[0])


def _nothing_known(paths: int, log_evidence: float) -> Associations:
    """No path was given to anything."""
    unassigned = np.full(paths, NONE)
    return Associations(
        ids=unassigned[None],
        weight=np.ones(1),
        born=unassigned,
        nis=0.0,
        nis_dof=0,
        log_evidence=log_evidence,
        sources=np.array([BS_ID]),
        log_missed=np.zeros(1),
        log_new=np.zeros(paths),
    )
