"""Tasks: common random numbers, judged at every step, and errors told instead of raised."""

from __future__ import annotations

import signal
from collections.abc import Callable

import numpy as np
import pytest

from dopslam_ros.core.settings.model import with_doppler_std
from dopslam_ros.lab.study.labels import make_estimator
from dopslam_ros.lab.study.plan import Plan, Task, run_generator, software
from dopslam_ros.lab.study.results import Results
from dopslam_ros.lab.study.run import FIELDS, check_software, execute, run_task
from dopslam_ros.offline.evaluation import judge_step
from dopslam_ros.simulation.scenario import Scenario
from dopslam_ros.simulation.simulator import simulate

FILTERS = ("joint", "marginal", "genie", "dead_reckoning")
DOPPLERS = (0.1, 0.5, None)
BOUNDS = ("peb", "heb", "ceb")
ERRORS = ("error_x", "error_y", "error_heading", "error_clock")


@pytest.fixture(scope="module")
def results(short: Scenario, do: Callable[[Plan], Results]) -> Results:
    return do(Plan(short, FILTERS, DOPPLERS, 3, 9))


def test_the_truth_is_the_same_for_all(results: Results) -> None:
    """The error of dead reckoning is the true motion less the nominal one: no Doppler in it."""
    tables = [results.tables["dead_reckoning", doppler][..., :4] for doppler in DOPPLERS]
    assert tables[0].tobytes() == tables[1].tobytes() == tables[2].tobytes()
    assert len({table.tobytes() for table in tables[0]}) == 3  # but not from run to run


def test_the_paths_are_the_same_for_all(results: Results) -> None:
    """The bounds take the detections drawn: one more or less and they differ."""
    for doppler in DOPPLERS:
        for name in BOUNDS:
            bounds = [results.field(label, doppler, name) for label in FILTERS]
            assert all(bound.tobytes() == bounds[0].tobytes() for bound in bounds)
    peb = [results.field("joint", doppler, "peb")[:, -1] for doppler in DOPPLERS]
    assert np.all(peb[0] < peb[1]) and np.all(peb[1] < peb[2])


def test_only_the_doppler_differs(short: Scenario) -> None:
    scenarios = [with_doppler_std(short, doppler) for doppler in DOPPLERS]
    runs = [list(simulate(scenario, run_generator(9, 1))) for scenario in scenarios]
    for fine, coarse, none in zip(*runs, strict=True):
        values = [snapshot.measurements.values for snapshot in (fine, coarse, none)]
        assert (
            values[0][:, :5].tobytes() == values[1][:, :5].tobytes() == values[2][:, :5].tobytes()
        )
        real = fine.sources >= 0
        assert np.all(values[0][real, 5] != values[1][real, 5]) and np.isnan(values[2][:, 5]).all()


def test_every_step_is_judged(short: Scenario) -> None:
    """Errors and NEES are those of the filter's estimates, taken afresh."""
    plan = Plan(short, ("joint:gamma=3",), (0.2,), 2, 9)
    part = run_task(plan, Task("joint:gamma=3", 0.2, 1))
    assert part.table.shape == (8, len(FIELDS)) and part.seconds.shape == (8,)
    assert np.isfinite(part.table).all() and np.all(part.seconds > 0.0)
    column = dict(zip(FIELDS, part.table.T, strict=True))
    assert np.all(column["correct_weight"] <= 1.0 + 1e-12)
    assert np.all(column["gospa_va"] <= 60.0)
    scenario = with_doppler_std(short, 0.2)
    estimator = make_estimator("joint:gamma=3", scenario, {})
    for step, snapshot in enumerate(simulate(scenario, run_generator(9, 1))):
        estimate = estimator.step(snapshot)
        error = estimate.mean - snapshot.state
        error[2] = np.arctan2(np.sin(error[2]), np.cos(error[2]))
        np.testing.assert_allclose([column[name][step] for name in ERRORS], error, atol=1e-12)
        nees = error @ np.linalg.inv(estimate.covariance) @ error
        assert column["nees"][step] == pytest.approx(nees, rel=1e-6)


def test_a_task_is_the_same_alone_and_among_others(short: Scenario, results: Results) -> None:
    alone = run_task(Plan(short, ("marginal",), (None,), 3, 9), Task("marginal", None, 2))
    assert alone.table.tobytes() == results.tables["marginal", None][2].tobytes()
    other = run_task(Plan(short, ("marginal",), (None,), 3, 10), Task("marginal", None, 2))
    assert other.table.tobytes() != alone.table.tobytes()


def test_settings_of_all_filters_count(short: Scenario) -> None:
    plans = [Plan(short, ("joint",), (0.1,), 1, 9, settings) for settings in ({}, {"gamma": 1})]
    tables = [run_task(plan, Task("joint", 0.1, 0)).table for plan in plans]
    one = run_task(Plan(short, ("joint:gamma=1",), (0.1,), 1, 9), Task("joint:gamma=1", 0.1, 0))
    assert tables[0].tobytes() != tables[1].tobytes() == one.table.tobytes()


def test_a_task_that_fails_is_told(short: Scenario) -> None:
    plan, task = Plan(short, ("joint",), (0.1,), 1, 9), Task("joint", 0.1, 0)
    assert execute(plan, software(), task).part is not None

    def fail(*arguments: object) -> None:
        raise np.linalg.LinAlgError("singular matrix")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("dopslam_ros.core.monitoring.recovery.step", fail)
        outcome = execute(plan, software(), task)
    assert outcome.task == task and outcome.part is None
    assert outcome.error.strip().endswith(
        "EstimatorError: no estimate at step 0: numerical_failure"
    )
    assert "Traceback" in outcome.error


def test_ctrl_c_ends_a_run_between_two_steps(short: Scenario) -> None:
    """An exception at any moment would crash the process in a compiled function."""
    plan, task = Plan(short, ("joint",), (0.1,), 1, 9), Task("joint", 0.1, 0)
    steps: list[int] = []

    def judge(*arguments: object) -> object:
        steps.append(1)
        signal.raise_signal(signal.SIGINT)
        return judge_step(*arguments)  # type: ignore[arg-type]

    before = signal.getsignal(signal.SIGINT)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("dopslam_ros.lab.study.run.judge_step", judge)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        with pytest.raises(KeyboardInterrupt):
            execute(plan, software(), task)
        assert len(steps) == 1
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # as in the processes of a pool
        try:
            assert execute(plan, software(), task).part is not None
        finally:
            signal.signal(signal.SIGINT, before)


def test_another_version_computes_nothing(short: Scenario) -> None:
    check_software(software())
    versions = {**software(), "numpy": "1.26.0"}
    outcome = execute(Plan(short, ("joint",), (0.1,), 1, 9), versions, Task("joint", 0.1, 0))
    assert outcome.part is None
    assert f"a worker has numpy {np.__version__}, the study 1.26.0" in outcome.error
