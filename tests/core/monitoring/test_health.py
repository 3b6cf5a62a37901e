"""Health: sound runs raise no alarm, a vehicle that was moved does; the map is not spoilt."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dopslam_ros.core.models.measurements import MeasurementSet
from dopslam_ros.core.monitoring.health import LOST_AT, Level
from dopslam_ros.core.pmb import FilterParameters
from dopslam_ros.core.session.filtering import FilterSession
from dopslam_ros.core.session.output import FilterOutput
from dopslam_ros.simulation.matched import filter_parameters_for
from dopslam_ros.simulation.scenario import Scenario, load_scenario
from dopslam_ros.simulation.simulator import simulate


def outputs_of(
    scenario: Scenario, parameters: FilterParameters, seed: int, silent: range = range(0)
) -> list[FilterOutput]:
    """All outputs of a run; sets numbered in ``silent`` come without a path."""
    session = FilterSession(parameters)
    outputs: list[FilterOutput] = []
    for s in simulate(scenario, np.random.default_rng(seed)):
        sets = s.measurements
        if s.step in silent:
            sets = MeasurementSet(sets.values[:0], sets.covariances[:0])
        list(session.add_control(s.stamp_ns, *s.control))
        outputs += session.add_measurements(s.stamp_ns, sets)
    return outputs


@pytest.mark.parametrize("scene", ["paper", "clutter", "misdetections", "blocked", "straight"])
def test_a_sound_run_is_never_lost_and_far_from_it(scene: str) -> None:
    scenario = load_scenario(scene)
    for seed in range(2):
        outputs = outputs_of(scenario, filter_parameters_for(scenario), seed)
        assert all(o.health.level != Level.LOST for o in outputs)
        assert max(o.health.cusum for o in outputs) < LOST_AT
        if scene == "paper":
            assert {o.health.level for o in outputs} == {Level.OK}
            assert 0.6 < outputs[-1].health.nis_ratio < 1.4


def test_noise_larger_than_stated_is_told() -> None:
    scenario = load_scenario("paper")
    parameters = filter_parameters_for(scenario)
    noise = np.multiply(1.6, scenario.measurement_noise_std)
    louder = replace(scenario, measurement_noise_std=tuple(noise.tolist()))
    outputs = outputs_of(louder, parameters, 1)
    assert outputs[-1].health.level == Level.WARN
    assert "NIS" in outputs[-1].health.reason
    assert outputs[-1].health.nis_ratio > 1.5


def test_a_position_known_worse_than_stated_is_told() -> None:
    scenario = load_scenario("paper")
    parameters = filter_parameters_for(scenario, health_position_std=0.01)
    last = outputs_of(scenario, parameters, 1)[-1].health
    assert last.level == Level.WARN and "stated are 0.01 m" in last.reason


def test_empty_sets_do_not_cost_the_map() -> None:
    """A receiver that hears nothing for 10 s: all landmarks would be given up as gone."""
    scenario = load_scenario("paper")
    parameters = filter_parameters_for(scenario)
    silent = range(15, 35)
    outputs = outputs_of(scenario, parameters, 2, silent)
    before = set(outputs[silent.start - 1].landmarks.ids.tolist())
    assert outputs[silent.stop - 1].health.level == Level.LOST
    assert before <= set(outputs[silent.stop - 1].landmarks.ids.tolist())
    assert outputs[-1].health.level == Level.OK
    assert np.sqrt(np.trace(outputs[-1].state.ue_covariance[:2, :2])) < 0.5
