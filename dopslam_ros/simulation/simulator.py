"""Draws a run of a scenario: true states and, at each snapshot, a shuffled set of paths."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from dopslam_ros.core.linalg.arrays import BoolArray, FloatArray, IntArray, wrap_angle
from dopslam_ros.core.models.channel import observe
from dopslam_ros.core.models.detection import detection_probabilities
from dopslam_ros.core.models.measurements import MeasurementSet
from dopslam_ros.core.models.motion import Control, propagate
from dopslam_ros.core.settings.layout import AZIMUTHS, DIM, HEADING, LandmarkType, X, Y
from dopslam_ros.core.settings.model import clutter_box
from dopslam_ros.simulation.scenario import Scenario

CLUTTER = -1


@dataclass(frozen=True)
class Snapshot:
    """One step of a simulated run.

    Attributes:
        step: 0, 1, ...
        stamp_ns: its time.
        control: valid from here to the next snapshot.
        state: (U,) the true state.
        measurements: what the channel estimator delivers.
        sources: (J,) where each path came from: 0 the BS, i the i-th landmark (from 1), or CLUTTER.
    """

    step: int
    stamp_ns: int
    control: Control
    state: FloatArray
    measurements: MeasurementSet
    sources: IntArray


def nominal_trajectory(scenario: Scenario) -> FloatArray:
    """(K, U) the states without process noise, from the mean of the prior on."""
    states = [np.array(scenario.initial_state)]
    for control in scenario.controls[:-1]:
        states.append(propagate(states[-1], control, scenario.period))
    return np.array(states)


def all_landmarks(scenario: Scenario) -> tuple[FloatArray, IntArray]:
    """(1 + I, 3) positions and (1 + I,) types, the BS first."""
    positions = np.vstack([scenario.bs, scenario.landmarks])
    types = np.concatenate([[int(LandmarkType.BS)], scenario.landmark_types])
    return positions, types.astype(np.int64)


def visible(scenario: Scenario, state: FloatArray, step: int) -> BoolArray:
    """(1 + I,) which landmarks, the BS first, have a path to the vehicle.

    Args:
        scenario: the scene.
        state: (U,) of the vehicle.
        step: number of the snapshot, 0, 1, ...: some may be blocked then.
    """
    positions, types = all_landmarks(scenario)
    speed = scenario.controls[step].speed
    paths = observe(state, speed, positions, types, scenario.bs, scenario.ue_height)
    ue = np.array([state[X], state[Y], scenario.ue_height])
    inside = detection_probabilities(scenario, ue, positions, types) > 0.0
    return inside & paths.facing & ~paths.degenerate & ~scenario.blocked_at(step)


def simulate(scenario: Scenario, rng: np.random.Generator) -> Iterator[Snapshot]:
    """A run: true motion with process noise, misdetections, measurement noise, clutter, shuffled.

    The initial state is drawn from the scenario's prior. Each snapshot draws from a generator of
    its own, so that a component less or a landmark more changes nothing at other snapshots.

    Args:
        scenario: the scene.
        rng: seeded generator; the only source of randomness.
    """
    noises, paths, clutter = rng.spawn(3)
    state = noises.normal(scenario.initial_state, scenario.initial_std)
    state[HEADING] = wrap_angle(state[HEADING])
    noise_std = np.sqrt(scenario.noise_rate * scenario.period)
    for step, control in enumerate(scenario.controls):
        measurements, sources = _draw_set(
            scenario, state, step, paths.spawn(1)[0], clutter.spawn(1)[0]
        )
        yield Snapshot(step, scenario.stamp_ns(step), control, state.copy(), measurements, sources)
        state = propagate(state, control, scenario.period) + noises.normal(0.0, noise_std)
        state[HEADING] = wrap_angle(state[HEADING])


def _draw_set(
    scenario: Scenario,
    state: FloatArray,
    step: int,
    rng: np.random.Generator,
    clutter_rng: np.random.Generator,
) -> tuple[MeasurementSet, IntArray]:
    positions, types = all_landmarks(scenario)
    speed = scenario.controls[step].speed
    paths = observe(state, speed, positions, types, scenario.bs, scenario.ue_height)
    std = np.array(scenario.measurement_noise_std)
    noisy = paths.mean + std * rng.standard_normal((len(types), DIM))
    chance = rng.random(len(types))
    detected = visible(scenario, state, step) & (chance < scenario.detection_probability)

    box = clutter_box(scenario)
    false_paths = clutter_rng.uniform(
        box[:, 0], box[:, 1], (clutter_rng.poisson(scenario.clutter_mean), DIM)
    )
    values = np.vstack([noisy[detected], false_paths])
    values[:, AZIMUTHS] = wrap_angle(values[:, AZIMUTHS])
    values[:, ~scenario.used_components] = np.nan
    sources = np.concatenate(
        [np.flatnonzero(detected), np.full(len(false_paths), CLUTTER, dtype=np.int64)]
    )
    order = clutter_rng.permutation(len(values))
    covariances = np.zeros((len(values), DIM, DIM))
    return MeasurementSet(values[order], covariances), sources[order]
