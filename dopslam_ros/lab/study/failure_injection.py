"""Runs in which the vehicle gets lost, and how soon and how well the filter finds it again."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from dopslam_ros.core.linalg.arrays import FloatArray
from dopslam_ros.core.models.channel import observe
from dopslam_ros.core.models.measurements import MeasurementSet
from dopslam_ros.core.models.motion import Control, propagate
from dopslam_ros.core.monitoring.health import Level
from dopslam_ros.core.session.filtering import FilterSession
from dopslam_ros.core.settings.layout import LandmarkType
from dopslam_ros.offline.metrics import nees, state_errors
from dopslam_ros.simulation.matched import filter_parameters_for
from dopslam_ros.simulation.scenario import Scenario
from dopslam_ros.simulation.simulator import Snapshot, simulate

BLACKOUT = 10.0  # [s]
KIDNAPPED = 20.0  # [m]
# Sets before the trouble at least, and after it.
FEWEST_BEFORE, AFTER = 10, 20
# Recovered: not lost, and the error no larger than the covariance allows (4 numbers, 99.99 %) nor
# than this [m].
MOST_NEES, MOST_ERROR = 23.5, 3.0
# Places tried for a kidnap that leaves the vehicle between the walls.
TRIES = 1000


@dataclass(frozen=True)
class Trial:
    """One run with trouble, the sets counted from the first one after it.

    Attributes:
        kind: of the trouble.
        noticed: set at which the vehicle was found to be lost, or 0 if it never was.
        recovered: set from which on it was found again for good, or 0 if it was not.
        error: (n, 4) of the estimates from then on.
        covariance: (n, 4, 4) of them.
        seconds: (n,) time of the steps while it was lost.
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


@dataclass(frozen=True)
class _Input:
    """A set, the control given with it (None: none is), and the truth."""

    stamp_ns: int
    measurements: MeasurementSet | None
    control: Control | None
    state: FloatArray


def trial(kind: str, scenario: Scenario, rng: np.random.Generator) -> Trial:
    """One run with trouble of a kind.

    Args:
        kind: one of TROUBLES.
        scenario: the scene.
        rng: seeded.
    """
    before, after = _story(kind, scenario, rng)
    parameters = filter_parameters_for(scenario)
    session = FilterSession(parameters)
    for one in before:
        _feed(session, one)
    if kind in ("no_prior", "no_map"):
        known = session.known_map()
        session = FilterSession(replace(parameters, initial_pose="unknown"))
        if kind == "no_prior":
            session.replace_map(known)
    return _watched(kind, session, after)


def _feed(session: FilterSession, one: _Input) -> bool:
    """Gives the session its inputs; whether there was a result."""
    outputs = []
    if one.control is not None:
        outputs += list(session.add_control(one.stamp_ns, *one.control))
    if one.measurements is not None:
        outputs += list(session.add_measurements(one.stamp_ns, one.measurements))
    return bool(outputs)


def _watched(kind: str, session: FilterSession, after: list[_Input]) -> Trial:
    noticed = recovered = 0
    losses = session.health.losses
    errors, covariances, seconds, good = [], [], [], []
    for number, one in enumerate(after, start=1):
        assert one.control is not None and one.measurements is not None
        list(session.add_control(one.stamp_ns, *one.control))
        (output,) = session.add_measurements(one.stamp_ns, one.measurements)
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


def _story(
    kind: str, scenario: Scenario, rng: np.random.Generator
) -> tuple[list[_Input], list[_Input]]:
    """The inputs before and after the trouble; without any, all are after it."""
    if kind == "none":
        return [], [_given(s) for s in simulate(scenario, rng)]
    gap = round(BLACKOUT / scenario.period) if kind in ("blackout", "dark") else 0
    laps = replace(scenario, controls=scenario.controls * 3)
    lap = scenario.steps
    first = int(rng.integers(lap, 2 * lap)) if kind != "no_map" else int(rng.integers(1, lap))
    snapshots = list(simulate(replace(laps, controls=laps.controls[:first]), rng))
    before = [_given(s) for s in snapshots]
    controls = laps.controls[first : first + gap + AFTER]
    state, control = snapshots[-1].state, snapshots[-1].control
    state = propagate(state, control, scenario.period)
    if kind == "kidnap":
        state = _kidnapped(scenario, state, controls, rng)
    if kind == "dark":
        turn = rng.uniform(-1.0, 1.0) * abs(control.turn_rate)
        controls = (Control(control.speed, turn),) * gap + controls[gap:]
    later = replace(
        scenario, controls=controls, initial_state=tuple(state), initial_std=(1e-9,) * 4
    )
    rest = []
    for s in simulate(later, rng):
        moved = replace(s, stamp_ns=s.stamp_ns + first * scenario.period_ns)
        silent = s.step < gap
        rest.append(
            _Input(
                moved.stamp_ns,
                None if silent else s.measurements,
                None if silent and kind == "dark" else s.control,
                s.state,
            )
        )
    return before + rest[:gap], rest[gap:]


def _given(snapshot: Snapshot) -> _Input:
    return _Input(snapshot.stamp_ns, snapshot.measurements, snapshot.control, snapshot.state)


def _kidnapped(
    scenario: Scenario,
    state: FloatArray,
    controls: tuple[Control, ...],
    rng: np.random.Generator,
) -> FloatArray:
    """Another place and heading from which the walls in sight stay in sight."""
    seen = _walls(scenario, state)
    for _ in range(TRIES):
        direction, heading = rng.uniform(-math.pi, math.pi, 2)
        offset = [KIDNAPPED * math.cos(direction), KIDNAPPED * math.sin(direction), heading, 0.0]
        moved = state + np.array(offset)
        if all((_walls(scenario, s) == seen).all() for s in _path(moved, controls, scenario)):
            return np.asarray(moved)
    raise ValueError(f"scene '{scenario.name}' has no place to bring the vehicle to")


def _path(
    state: FloatArray, controls: tuple[Control, ...], scenario: Scenario
) -> Iterator[FloatArray]:
    for control in controls:
        yield state
        state = propagate(state, control, scenario.period)


def _walls(scenario: Scenario, state: FloatArray) -> FloatArray:
    """Which of the walls face the vehicle."""
    walls = scenario.landmark_types == LandmarkType.VA
    types = scenario.landmark_types[walls]
    paths = observe(state, 0.0, scenario.landmarks[walls], types, scenario.bs, scenario.ue_height)
    return np.asarray(paths.facing)
