"""A run in which the vehicle gets lost, and how soon and how well the filter finds it again."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from dopslam_ros.core.linalg.arrays import FloatArray
from dopslam_ros.core.monitoring.health import Level
from dopslam_ros.core.session.filtering import FilterSession
from dopslam_ros.core.session.output import FilterOutput
from dopslam_ros.lab.failure_injection.inputs import Input, inputs_of
from dopslam_ros.offline.metrics import nees, state_errors
from dopslam_ros.simulation.matched import filter_parameters_for
from dopslam_ros.simulation.scenario import Scenario

# Recovered: not lost, and the error no larger than the covariance allows (4 numbers, 99.99 %) nor
# than this [m].
MOST_NEES, MOST_ERROR = 23.5, 3.0


@dataclass(frozen=True)
class Trial:
    """One run with a failure, the sets counted from the first one after it.

    Attributes:
        kind: of the failure.
        noticed: set at which the vehicle was found to be lost, or 0 if it never was.
        recovered: set from which on it was found again for good, or 0 if it was not.
        error: (n, 4) of the estimates from then on.
        covariance: (n, 4, 4) of them.
        seconds: (m,) time of the steps while it was lost.
    """

    kind: str
    noticed: int
    recovered: int
    error: FloatArray
    covariance: FloatArray
    seconds: FloatArray

    @property
    def nees(self) -> FloatArray:
        """(n,) of the estimates after the recovery."""
        return np.array([nees(e, p) for e, p in zip(self.error, self.covariance, strict=True)])


def trial(kind: str, scenario: Scenario, rng: np.random.Generator) -> Trial:
    """One run with a failure.

    Args:
        kind: one of FAILURES.
        scenario: the scene.
        rng: seeded.
    """
    before, after = inputs_of(kind, scenario, rng)
    parameters = filter_parameters_for(scenario)
    session = FilterSession(parameters)
    for one in before:
        _feed(session, one)
    if kind in ("no_prior", "no_map"):
        known = session.known_map()
        session = FilterSession(replace(parameters, initial_pose="unknown"))
        if kind == "no_prior":
            session.replace_map(known)
    return _observed(kind, session, after)


def _feed(session: FilterSession, one: Input) -> list[FilterOutput]:
    """Gives the session its inputs."""
    outputs: list[FilterOutput] = []
    if one.control is not None:
        outputs += session.add_control(one.stamp_ns, *one.control)
    if one.measurements is not None:
        outputs += session.add_measurements(one.stamp_ns, one.measurements)
    return outputs


def _observed(kind: str, session: FilterSession, after: list[Input]) -> Trial:
    """The trial, from what the session makes of the inputs after the failure."""
    noticed = recovered = 0
    losses = session.health.losses
    errors, covariances, seconds, good = [], [], [], []
    for number, one in enumerate(after, start=1):
        (output,) = _feed(session, one)
        error = state_errors(output.state.ue_mean, one.state)
        covariance = output.state.ue_covariance
        lost = output.health.level == Level.LOST
        if output.health.losses > losses:
            noticed = noticed or number
        if lost:
            seconds.append(output.step_seconds)
        close = math.hypot(error[0], error[1]) < MOST_ERROR
        good.append(not lost and close and nees(error, covariance) < MOST_NEES)
        errors.append(error)
        covariances.append(covariance)
    if good[-1]:
        recovered = len(good) - int(np.argmin([*good[::-1], False])) + 1
    since = slice(recovered - 1 if recovered else len(good), None)
    return Trial(
        kind,
        noticed,
        recovered,
        np.array(errors)[since],
        np.array(covariances)[since],
        np.array(seconds),
    )
