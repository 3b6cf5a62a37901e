"""The filter on the paper's scene: no worse than published, believable, and the same every time."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from dopslam_ros.core.evaluation import StepRecord, summarise
from dopslam_ros.core.filter import FilterParameters
from dopslam_ros.core.model import with_doppler_std
from dopslam_ros.core.scenario import Scenario, load_scenario
from dopslam_ros.core.study import filter_parameters_for, run_once
from dopslam_ros.published import published

SEED = 40_417
RUNS = 10
DOPPLER = {"with_doppler": 0.1, "without_doppler": None}


def scene(sigma_d: float | None) -> Scenario:
    return with_doppler_std(load_scenario("paper"), sigma_d)


def study(
    scenario: Scenario, parameters: FilterParameters, runs: int
) -> tuple[dict[str, Any], list[list[StepRecord]]]:
    records = [run_once(scenario, parameters, SEED, run) for run in range(runs)]
    return summarise(records), records


@pytest.fixture(scope="module")
def joint() -> dict[str, dict[str, Any]]:
    """Summaries with and without Doppler of the form that keeps the correlations."""
    summaries = {}
    for name, sigma_d in DOPPLER.items():
        scenario = scene(sigma_d)
        summaries[name], _ = study(scenario, filter_parameters_for(scenario), RUNS)
    return summaries


@pytest.mark.parametrize("name", list(DOPPLER))
def test_the_errors_are_no_worse_than_published(
    joint: dict[str, dict[str, Any]], name: str
) -> None:
    summary, figure = joint[name], published().content["fig_rmse"][name]
    assert summary["position_rmse"] < figure["position_m"]
    assert summary["heading_rmse_deg"] < figure["heading_deg"]
    assert summary["clock_bias_rmse"] < figure["clock_bias_m"]
    assert 2.5 < summary["nees_mean"] < 7.0
    # Not better than possible either: a filter that peeks at the truth would be.
    assert summary["position_rmse"] > 0.75 * summary["bound_position_rms"]


def test_doppler_helps(joint: dict[str, dict[str, Any]]) -> None:
    better, worse = joint["with_doppler"], joint["without_doppler"]
    for name in ("position_rmse", "heading_rmse_deg", "bound_position_rms"):
        assert better[name] < worse[name]
    for name in ("gospa_va", "gospa_sp"):
        assert np.mean(better[name]) < np.mean(worse[name])


def test_the_map_is_found(joint: dict[str, dict[str, Any]]) -> None:
    summary = joint["with_doppler"]
    # Before anything is sure nothing is reported of four; at the end all are there.
    assert summary["gospa_sp"][0] == pytest.approx(math.sqrt(800.0))
    assert np.mean(summary["gospa_va"][-10:]) < 4.0
    assert np.mean(summary["gospa_sp"][-10:]) < 4.0
    assert summary["steps"] == 40 and len(summary["gospa_va"]) == 40


def test_the_correct_association_weighs_more_than_published(
    joint: dict[str, dict[str, Any]],
) -> None:
    weights = published().content["correct_association_weight"]
    for name, summary in joint.items():
        assert weights[name] < summary["correct_association_weight"] <= 1.0


@pytest.mark.parametrize("name", list(DOPPLER))
def test_the_marginal_form_runs(name: str) -> None:
    scenario = scene(DOPPLER[name])
    parameters = filter_parameters_for(scenario, coupling="marginal")
    summary, records = study(scenario, parameters, 4)
    assert all(np.isfinite(step.error).all() for run in records for step in run)
    assert summary["position_rmse"] < 1.5
    assert summary["heading_rmse_deg"] < 1.0
    # Overconfident: what dropping the correlations costs.
    assert summary["nees_mean"] > 8.0


def test_the_same_inputs_give_the_same_bytes() -> None:
    scenario = scene(0.1)
    parameters = filter_parameters_for(scenario)
    one, other = (run_once(scenario, parameters, SEED, 3) for _ in range(2))
    assert len(one) == 40
    for a, b in zip(one, other, strict=True):
        assert a.error.tobytes() == b.error.tobytes()
        assert (a.nees, a.gospa_va, a.gospa_sp) == (b.nees, b.gospa_va, b.gospa_sp)
        assert a.correct_weight == b.correct_weight


NAN = math.nan
LESS = {
    "elevations": (0.1, 0.05, NAN, 0.05, NAN, 0.1),
    "departure angles": (0.1, 0.05, 0.05, NAN, NAN, 0.1),
    "Doppler and departure angles": (0.1, 0.05, 0.05, NAN, NAN, NAN),
    "arrival angles": (0.1, NAN, NAN, 0.05, 0.05, 0.1),
}


@pytest.mark.parametrize("name", list(LESS))
def test_it_works_without(name: str) -> None:
    scenario = replace(load_scenario("paper"), measurement_noise_std=LESS[name])
    summary, records = study(scenario, filter_parameters_for(scenario), 3)
    assert all(np.isfinite(step.error).all() for run in records for step in run)
    assert summary["position_rmse"] < 1.2
    assert summary["heading_rmse_deg"] < 1.0
