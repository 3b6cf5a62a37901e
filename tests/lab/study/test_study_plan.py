"""Plans: what is to be computed, in which order, and all of it in a file."""

from __future__ import annotations

import json
import math
from dataclasses import fields, replace

import numpy as np
import pytest

from dopslam_ros.core.settings.parameters import ParameterError
from dopslam_ros.lab.study.plan import (
    Plan,
    StudyError,
    Task,
    differences,
    parse_plan,
    plan_content,
    run_generator,
    software,
)
from dopslam_ros.simulation.scenario import (
    Scenario,
    load_scenario,
    parse_scenario,
    scenario_content,
)
from dopslam_ros.simulation.scenes import builtin_scenarios
from dopslam_ros.system.files import json_text


def same(a: Scenario, b: Scenario) -> bool:
    return all(
        np.array_equal(np.array(getattr(a, f.name)), np.array(getattr(b, f.name)), equal_nan=True)
        if f.name == "measurement_noise_std"
        else np.array_equal(getattr(a, f.name), getattr(b, f.name))
        for f in fields(Scenario)
    )


@pytest.mark.parametrize("name", builtin_scenarios())
def test_a_scene_is_made_again_of_its_content(name: str) -> None:
    scenario = load_scenario(name)
    assert same(parse_scenario(json.loads(json.dumps(scenario_content(scenario)))), scenario)


def test_a_plan_is_read_from_its_file() -> None:
    """Every digit, also where nothing is measured, which JSON has no number for."""
    scenario = replace(
        load_scenario("paper"),
        measurement_noise_std=(0.1, 1 / 3, math.nan, 0.05, math.nan, 0.1),
        name="odd",
    )
    settings = {"gamma": 7, "initial_std": (0.1, 0.2, 0.3, 0.4), "prune_type": 1 / 7}
    plan = Plan(scenario, ("joint", "genie"), (0.1, None, 1 / 3), 4, 9, settings)
    content = json.loads(json_text(plan_content(plan)))
    assert content["software"] == software()
    again = parse_plan(content)
    assert same(again.scenario, scenario)
    assert again.dopplers == plan.dopplers and again.filters == plan.filters
    assert (again.runs, again.seed, again.settings) == (4, 9, settings)
    # Not only equal: written again it is the same file.
    assert json_text(plan_content(again)) == json_text(plan_content(plan))


def test_whole_runs_come_first(short: Scenario) -> None:
    tasks = list(Plan(short, ("genie", "joint"), (None, 0.1), 3, 1).tasks())
    assert tasks[:4] == [
        Task("genie", None, 0),
        Task("joint", None, 0),
        Task("genie", 0.1, 0),
        Task("joint", 0.1, 0),
    ]
    assert [task.run for task in tasks] == [run for run in range(3) for _ in range(4)]
    assert str(tasks[2]) == "filter genie, Doppler 0.1, run 0"


def test_each_run_has_a_generator_of_its_own() -> None:
    numbers = {(s, r): run_generator(s, r).random() for s in (1, 2) for r in (0, 1, 2)}
    assert len(set(numbers.values())) == 6
    assert run_generator(2, 1).random() == numbers[2, 1]
    assert numbers[2, 1] == np.random.default_rng([2, 1]).random()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"filters": ()}, "at least one filter"),
        ({"dopplers": ()}, "at least one Doppler noise"),
        ({"filters": ("joint", "genie", "joint")}, "filter joint is given twice"),
        ({"dopplers": (0.1, None, None)}, "Doppler noise None is given twice"),
        ({"dopplers": (0.0,)}, "Doppler noise 0.0 m/s: give a number above 0"),
        ({"dopplers": (math.nan,)}, "Doppler noise nan m/s"),
        ({"runs": 0}, "runs 0"),
        ({"seed": -1}, "seed -1"),
    ],
)
def test_plans_that_cannot_be(short: Scenario, change: dict[str, object], words: str) -> None:
    plan = Plan(short, ("joint",), (0.1,), 1, 1)
    with pytest.raises(StudyError, match=words):
        replace(plan, **change)


def test_a_plan_knows_its_filters(short: Scenario) -> None:
    with pytest.raises(ParameterError, match="did you mean 'marginal'"):
        Plan(short, ("joint", "marginl"), (0.1,), 1, 1)
    with pytest.raises(ParameterError, match="coupling = joint, not marginal"):
        Plan(short, ("joint",), (0.1,), 1, 1, {"coupling": "marginal"})


def test_what_is_no_plan(short: Scenario) -> None:
    content = json.loads(json_text(plan_content(Plan(short, ("joint",), (0.1,), 1, 1))))
    for broken in ({}, [], {**content, "scenario": {"speeed": 1}}, {**content, "runs": "many"}):
        with pytest.raises(StudyError, match=r"not (the|a) plan"):
            parse_plan(broken)


def test_differences_are_named() -> None:
    ours = {"seed": 1, "scenario": {"p": 0.9, "q": [1, 2]}, "settings": {"gamma": 3}}
    theirs = {"seed": 1, "scenario": {"p": 0.8, "q": [1, 2]}, "settings": {}}
    assert differences(ours, theirs) == [
        "scenario.p is 0.9, there 0.8",
        "settings.gamma is 3, there None",
    ]
    assert differences(ours, ours) == []
