"""What the tests of studies share: a scene of a few steps, and studies done here."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest

from dopslam_ros.lab.study.plan import Plan
from dopslam_ros.lab.study.results import Collection, Results
from dopslam_ros.lab.study.run import run_task
from dopslam_ros.simulation.scenario import Scenario, load_scenario


def study(plan: Plan) -> Results:
    """Every task, one after the other."""
    collection = Collection(plan, None)
    for task in plan.tasks():
        collection.add(task, run_task(plan, task))
    return collection.results()


@pytest.fixture(scope="session")
def short() -> Scenario:
    """The paper's scene, cut to a few steps."""
    scenario = load_scenario("paper")
    return replace(scenario, controls=scenario.controls[:8])


@pytest.fixture(scope="session")
def do() -> Callable[[Plan], Results]:
    """Function ``(plan)``: its results, computed in this process."""
    return study
