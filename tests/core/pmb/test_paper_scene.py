"""The filter on the paper's scene: no worse than published, believable, and the same every time."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from dopslam_ros.core.linalg.arrays import FloatArray
from dopslam_ros.lab.published import published
from dopslam_ros.lab.study.plan import Plan
from dopslam_ros.lab.study.results import Collection, Results
from dopslam_ros.lab.study.run import run_task
from dopslam_ros.lab.study.summary import summarise_study
from dopslam_ros.simulation.scenario import Scenario, load_scenario

SEED = 40_417
RUNS = 10
DOPPLER = {"with_doppler": 0.1, "without_doppler": None}


def study(scenario: Scenario, label: str, dopplers: tuple[float | None, ...], runs: int) -> Results:
    collection = Collection(Plan(scenario, (label,), dopplers, runs, SEED), None)
    for task in collection.plan.tasks():
        collection.add(task, run_task(collection.plan, task))
    return collection.results()


def row(results: Results, doppler: float | None) -> dict[str, Any]:
    """The values of the summary."""
    rows = {row["doppler"]: row for row in summarise_study(results)["rows"]}
    return {name: found["value"] for name, found in rows[doppler].items() if type(found) is dict}


def errors(results: Results, doppler: float | None) -> FloatArray:
    names = ("error_x", "error_y", "error_heading", "error_clock")
    return np.array([results.field(results.plan.filters[0], doppler, name) for name in names])


@pytest.fixture(scope="module")
def joint() -> Results:
    """With and without Doppler, the form that keeps the correlations."""
    return study(load_scenario("paper"), "joint", tuple(DOPPLER.values()), RUNS)


@pytest.mark.parametrize("name", list(DOPPLER))
def test_the_errors_are_no_worse_than_published(joint: Results, name: str) -> None:
    summary, figure = row(joint, DOPPLER[name]), published().content["fig_rmse"][name]
    assert summary["position_rmse"] < figure["position_m"]
    assert summary["heading_rmse_deg"] < figure["heading_deg"]
    assert summary["clock_bias_rmse"] < figure["clock_bias_m"]
    assert 2.5 < summary["nees_mean"] < 7.0
    # Not better than possible either: a filter that peeks at the truth would be.
    assert summary["position_rmse"] > 0.75 * summary["bound_position_rms"]


def test_doppler_helps(joint: Results) -> None:
    better, worse = (row(joint, doppler) for doppler in DOPPLER.values())
    for name in ("position_rmse", "heading_rmse_deg", "bound_position_rms"):
        assert better[name] < worse[name]
    for name in ("gospa_va", "gospa_sp"):
        means = [joint.field("joint", doppler, name).mean() for doppler in DOPPLER.values()]
        assert means[0] < means[1]


def test_the_map_is_found(joint: Results) -> None:
    # Before anything is sure nothing is reported of four; at the end all are there.
    gospa_sp = joint.field("joint", 0.1, "gospa_sp").mean(axis=0)
    assert gospa_sp[0] == pytest.approx(math.sqrt(800.0)) and len(gospa_sp) == 40
    summary = row(joint, 0.1)
    assert summary["gospa_va"] < 4.0 and summary["gospa_sp"] < 4.0


def test_the_correct_association_weighs_more_than_published(joint: Results) -> None:
    weights = published().content["correct_association_weight"]
    for name, doppler in DOPPLER.items():
        assert weights[name] < row(joint, doppler)["correct_association_weight"] <= 1.0


@pytest.mark.parametrize("name", list(DOPPLER))
def test_the_marginal_form_runs(name: str) -> None:
    results = study(load_scenario("paper"), "marginal", (DOPPLER[name],), 4)
    summary = row(results, DOPPLER[name])
    assert np.isfinite(errors(results, DOPPLER[name])).all()
    assert summary["position_rmse"] < 1.5
    assert summary["heading_rmse_deg"] < 1.0
    # Overconfident: what dropping the correlations costs.
    assert summary["nees_mean"] > 8.0


def test_the_same_inputs_give_the_same_bytes(joint: Results) -> None:
    plan = joint.plan
    again = run_task(plan, list(plan.tasks())[6])  # run 3, with Doppler
    assert again.table.shape[0] == 40
    assert again.table.tobytes() == joint.tables["joint", 0.1][3].tobytes()


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
    doppler = None if math.isnan(LESS[name][5]) else LESS[name][5]
    results = study(scenario, "joint", (doppler,), 3)
    summary = row(results, doppler)
    assert np.isfinite(errors(results, doppler)).all()
    assert summary["position_rmse"] < 1.2
    assert summary["heading_rmse_deg"] < 1.0
