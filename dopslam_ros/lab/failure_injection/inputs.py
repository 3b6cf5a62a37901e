"""The inputs of a run with a failure: what comes before it, and what comes after."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from dopslam_ros.core.linalg.arrays import BoolArray, FloatArray
from dopslam_ros.core.models.channel import observe
from dopslam_ros.core.models.measurements import MeasurementSet
from dopslam_ros.core.models.motion import Control, propagate
from dopslam_ros.core.settings.layout import LandmarkType
from dopslam_ros.simulation.scenario import Scenario
from dopslam_ros.simulation.simulator import Snapshot, simulate

BLACKOUT_SECONDS = 10.0
KIDNAP_METRES = 20.0
# Sets after the failure.
STEPS_AFTER = 20
# Positions tried for a kidnap that leaves the vehicle between the walls.
TRIES = 1000


@dataclass(frozen=True)
class Input:
    """A set (None: none comes), the control given with it (None: none is), and the truth (4,)."""

    stamp_ns: int
    measurements: MeasurementSet | None
    control: Control | None
    state: FloatArray


class Inputs(NamedTuple):
    """Those before and after a failure; without one, all are after it."""

    before: list[Input]
    after: list[Input]


def inputs_of(kind: str, scenario: Scenario, rng: np.random.Generator) -> Inputs:
    """Simulates a run with a failure at a random time.

    Args:
        kind: one of FAILURES.
        scenario: the scene, driven several times over.
        rng: seeded.
    """
    if kind == "none":
        return Inputs([], [_given(snapshot) for snapshot in simulate(scenario, rng)])
    gap = round(BLACKOUT_SECONDS / scenario.period) if kind in ("blackout", "dark") else 0
    laps = replace(scenario, controls=scenario.controls * 3)
    lap = scenario.steps
    first = int(rng.integers(lap, 2 * lap)) if kind != "no_map" else int(rng.integers(1, lap))
    snapshots = list(simulate(replace(laps, controls=laps.controls[:first]), rng))
    controls = laps.controls[first : first + gap + STEPS_AFTER]
    state, control = snapshots[-1].state, snapshots[-1].control
    state = propagate(state, control, scenario.period)
    if kind == "kidnap":
        state = _kidnapped(scenario, state, controls, rng)
    if kind == "dark":
        turn = rng.uniform(-1.0, 1.0) * abs(control.turn_rate)
        controls = (Control(control.speed, turn),) * gap + controls[gap:]
    later = replace(
        scenario, controls=controls, initial_state=tuple(state), initial_std=(1e-9,) * len(state)
    )
    rest = [
        Input(
            snapshot.stamp_ns + first * scenario.period_ns,
            None if snapshot.step < gap else snapshot.measurements,
            None if snapshot.step < gap and kind == "dark" else snapshot.control,
            snapshot.state,
        )
        for snapshot in simulate(later, rng)
    ]
    return Inputs([_given(snapshot) for snapshot in snapshots] + rest[:gap], rest[gap:])


def _given(snapshot: Snapshot) -> Input:
    return Input(snapshot.stamp_ns, snapshot.measurements, snapshot.control, snapshot.state)


def _kidnapped(
    scenario: Scenario,
    state: FloatArray,
    controls: tuple[Control, ...],
    rng: np.random.Generator,
) -> FloatArray:
    """Another position and heading from which the walls in sight stay in sight.

    Raises:
        ValueError: none was found.
    """
    seen = _facing_walls(scenario, state)
    for _ in range(TRIES):
        direction, heading = rng.uniform(-math.pi, math.pi, 2)
        along = [KIDNAP_METRES * math.cos(direction), KIDNAP_METRES * math.sin(direction)]
        moved = np.asarray(state + np.array([*along, heading, 0.0]))
        if all(
            (_facing_walls(scenario, at) == seen).all()
            for at in _states(moved, controls, scenario.period)
        ):
            return moved
    raise ValueError(f"scene '{scenario.name}' has no position to bring the vehicle to")


def _states(
    state: FloatArray, controls: tuple[Control, ...], period: float
) -> Iterator[FloatArray]:
    for control in controls:
        yield state
        state = propagate(state, control, period)


def _facing_walls(scenario: Scenario, state: FloatArray) -> BoolArray:
    """(W,) which of the walls face the vehicle."""
    walls = scenario.landmark_types == LandmarkType.VA
    types = scenario.landmark_types[walls]
    paths = observe(state, 0.0, scenario.landmarks[walls], types, scenario.bs, scenario.ue_height)
    return paths.facing
