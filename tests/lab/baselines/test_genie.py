"""The filter that knows the association, against the bound it should nearly reach."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dopslam_ros.core.linalg.arrays import FloatArray
from dopslam_ros.core.models.motion import ControlSpan
from dopslam_ros.core.pmb import FilterParameters
from dopslam_ros.core.session.bounding import BoundsSession, WorldState
from dopslam_ros.core.settings.model import with_doppler_std
from dopslam_ros.lab.baselines.genie import genie_step, initial_genie
from dopslam_ros.offline.metrics import nees, state_errors
from dopslam_ros.simulation.matched import bounds_parameters_for, filter_parameters_for
from dopslam_ros.simulation.scenario import Scenario, load_scenario
from dopslam_ros.simulation.simulator import all_landmarks, simulate

RUNS = 48


def run(
    scenario: Scenario, parameters: FilterParameters, seed: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Errors (K, 4), NEES (K,) and bounds (K, 3) of one run."""
    positions, types = all_landmarks(scenario)
    state, previous = initial_genie(parameters), None
    session = BoundsSession(bounds_parameters_for(scenario))
    errors, normalised, bounds = [], [], []
    for snapshot in simulate(scenario, np.random.default_rng([77, seed])):
        control = snapshot.control
        spans = [] if previous is None else [ControlSpan(previous, scenario.period)]
        state = genie_step(
            state,
            snapshot.measurements,
            snapshot.sources,
            types,
            spans,
            control.speed,
            parameters,
        )
        previous = control
        error = state_errors(state.mean[:4], snapshot.state)
        errors.append(error)
        normalised.append(nees(error, state.covariance[:4, :4]))
        detected = np.isin(np.arange(len(types)), snapshot.sources)
        world = WorldState(snapshot.state, np.arange(len(types)), types, positions, detected)
        list(session.add_control(snapshot.stamp_ns, control.speed, control.turn_rate))
        (output,) = session.add_world(snapshot.stamp_ns, world)
        bounds.append(output.with_doppler[:3])
    return np.array(errors), np.array(normalised), np.array(bounds)


@pytest.fixture(scope="module")
def study() -> tuple[FloatArray, FloatArray, FloatArray]:
    """Errors, NEES and bounds of RUNS runs of the paper's scene with Doppler."""
    scenario = with_doppler_std(load_scenario("paper"), 0.1)
    parameters = filter_parameters_for(scenario)
    results = [run(scenario, parameters, seed) for seed in range(RUNS)]
    errors, normalised, bounds = (np.array(part) for part in zip(*results, strict=True))
    return errors, normalised, bounds


def test_the_errors_are_as_large_as_the_bound(
    study: tuple[FloatArray, FloatArray, FloatArray],
) -> None:
    errors, _, bounds = study
    square = np.stack(
        [errors[..., 0] ** 2 + errors[..., 1] ** 2, errors[..., 2] ** 2, errors[..., 3] ** 2], -1
    )
    ratio = np.sqrt(square.mean(axis=(0, 1)) / (bounds**2).mean(axis=(0, 1)))
    # Errors of a run are correlated; runs are not. Two standard errors of the ratio on both sides.
    spread = np.sqrt(square.mean(axis=1)).std(axis=0) / np.sqrt(square.mean(axis=(0, 1)))
    margin = 2.0 * spread / np.sqrt(RUNS)
    assert np.all(margin < 0.15)
    assert np.all(ratio > 0.97 - margin), ratio
    assert np.all(ratio < 1.12 + margin), ratio


def test_the_covariance_can_be_believed(
    study: tuple[FloatArray, FloatArray, FloatArray],
) -> None:
    _, normalised, _ = study
    assert 3.3 < normalised.mean() < 5.0
    # At every stage of the run, not on average only.
    stages = normalised.mean(axis=0).reshape(4, 10).mean(axis=1)
    assert np.all(stages > 2.5) and np.all(stages < 6.5), stages


def test_clutter_and_misdetections_do_not_reach_the_genie() -> None:
    quiet = replace(load_scenario("paper"), detection_probability=0.0, clutter_mean=5.0)
    parameters = filter_parameters_for(quiet)
    _, types = all_landmarks(quiet)
    state = initial_genie(parameters)
    snapshot = next(iter(simulate(quiet, np.random.default_rng(1))))
    after = genie_step(state, snapshot.measurements, snapshot.sources, types, [], 22.22, parameters)
    assert len(snapshot.measurements) > 0
    np.testing.assert_array_equal(after.mean, state.mean)
    np.testing.assert_array_equal(after.covariance, state.covariance)
