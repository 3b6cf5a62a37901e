"""The scenes that come with the package: possible, and what their files say they are."""

from __future__ import annotations

import math

import numpy as np
import pytest
import yaml

from dopslam_ros.core.linalg.arrays import BoolArray
from dopslam_ros.core.models.channel import observe
from dopslam_ros.core.models.motion import propagate
from dopslam_ros.core.settings.layout import LandmarkType
from dopslam_ros.core.settings.model import clutter_box
from dopslam_ros.simulation.scenario import (
    Scenario,
    load_scenario,
    parse_scenario,
    scenario_content,
)
from dopslam_ros.simulation.scenes import builtin_scenarios
from dopslam_ros.simulation.simulator import all_landmarks, nominal_trajectory, visible

NAMES = builtin_scenarios()


def sight(scenario: Scenario) -> BoolArray:
    """(K, 1 + I) what has a path along the nominal track."""
    track = nominal_trajectory(scenario)
    return np.array([visible(scenario, state, step) for step, state in enumerate(track)])


def changed(scenario: Scenario) -> set[str]:
    """What in a scene's file differs from the paper's."""
    ours, paper = scenario_content(scenario), scenario_content(load_scenario("paper"))
    return {name for name in ours if ours[name] != paper[name]} - {"name"}


@pytest.mark.parametrize("name", NAMES)
def test_a_scene_is_possible(name: str) -> None:
    scenario = load_scenario(name)
    assert scenario.name == name and 40 <= scenario.steps <= 100
    positions, types = all_landmarks(scenario)
    # A VA at the height of the BS is its image in a vertical wall.
    assert np.all(positions[types == LandmarkType.VA, 2] == scenario.bs_position[2])
    assert np.all(positions[types == LandmarkType.SP, 2] <= 10.0)
    seen = sight(scenario)
    assert seen.any(axis=0).all()
    # Clutter covers all that the paths can be, with room for their noise.
    box = clutter_box(scenario)
    room = 3.0 * np.array(scenario.measurement_noise_std)
    for step, state in enumerate(nominal_trajectory(scenario)):
        speed = scenario.controls[step].speed
        paths = observe(state, speed, positions, types, scenario.bs)
        mean = paths.mean[seen[step]]
        for component in (0, 5):
            assert mean[:, component].min() - room[component] > box[component, 0]
            assert mean[:, component].max() + room[component] < box[component, 1]
        # Nothing is driven over.
        ground = positions[types == LandmarkType.SP, :2] - state[:2]
        assert np.hypot(ground[:, 0], ground[:, 1]).min() > 2.0


@pytest.mark.parametrize("name", NAMES)
def test_a_scene_can_be_written_and_read_again(name: str) -> None:
    scenario = load_scenario(name)
    content = scenario_content(scenario)
    again = parse_scenario(yaml.safe_load(yaml.safe_dump(content)))
    assert scenario_content(again) == content
    assert again.controls == scenario.controls and again.blocked == scenario.blocked
    np.testing.assert_array_equal(again.landmarks, scenario.landmarks)
    np.testing.assert_array_equal(sight(again), sight(scenario))


def test_straight_is_straight() -> None:
    scenario = load_scenario("straight")
    track = nominal_trajectory(scenario)
    assert np.ptp(track[:, 1]) == 0.0 and np.ptp(track[:, 2]) == 0.0
    np.testing.assert_allclose(np.diff(track[:, 0]), 7.5)


def test_the_figure_eight_turns_both_ways_and_closes() -> None:
    scenario = load_scenario("figure_eight")
    turns = np.array([c.turn_rate * scenario.period for c in scenario.controls])
    assert turns[:40].sum() == pytest.approx(2.0 * math.pi)
    assert turns[40:].sum() == pytest.approx(-2.0 * math.pi)
    track = nominal_trajectory(scenario)
    np.testing.assert_allclose(track[40], track[0], atol=1e-9)
    end = propagate(track[-1], scenario.controls[-1], scenario.period)
    np.testing.assert_allclose(end, track[0], atol=1e-9)
    assert {c.speed for c in scenario.controls} == {12.0, 20.0}


def test_the_street_grid_has_walls_that_come_and_go() -> None:
    scenario = load_scenario("street_grid")
    assert scenario.steps <= 60
    counts = [int((scenario.landmark_types == k).sum()) for k in (LandmarkType.VA, LandmarkType.SP)]
    assert counts == [20, 60]
    turns = [c.turn_rate for c in scenario.controls]
    signs = np.sign(turns)[np.flatnonzero(np.diff(np.sign(turns), prepend=0.0))]
    assert signs[signs != 0.0].tolist() == [-1.0, 1.0, -1.0]
    walls = sight(scenario)[:, 1:21].astype(int)
    assert (walls[0] < walls[-1]).sum() == 2 and (walls[0] > walls[-1]).sum() == 2
    # Along the streets or across them at the end of each turn.
    headings = nominal_trajectory(scenario)[np.array(turns) == 0.0, 2]
    quarter = headings / (math.pi / 2.0)
    np.testing.assert_allclose(quarter, np.round(quarter), atol=1e-9)


def test_the_bs_is_blocked_for_ten_seconds() -> None:
    scenario = load_scenario("blocked")
    assert changed(scenario) == {"blocked"}
    hidden = np.flatnonzero(~sight(scenario)[:, 0])
    assert hidden.tolist() == list(range(10, 30))
    paper = load_scenario("paper")
    np.testing.assert_array_equal(sight(scenario)[:, 1:], sight(paper)[:, 1:])


@pytest.mark.parametrize(
    ("name", "what", "value"),
    [("clutter", "clutter_mean", 5.0), ("misdetections", "detection_probability", 0.6)],
)
def test_a_harder_receiver_in_the_same_world(name: str, what: str, value: float) -> None:
    scenario = load_scenario(name)
    assert changed(scenario) == {what}
    assert getattr(scenario, what) == value


def test_far_is_far() -> None:
    scenario = load_scenario("far")
    assert changed(scenario) == {"landmarks", "clutter_path_length"}
    vas = scenario.landmarks[scenario.landmark_types == LandmarkType.VA]
    distance = np.hypot(vas[:, 0], vas[:, 1])
    assert distance.min() >= 450.0 and distance.max() == 500.0


def test_the_bounds_scene_differs_from_the_paper_where_it_says() -> None:
    scenario = load_scenario("paper_bounds")
    assert changed(scenario) == {"initial_std", "detection_probability"}
    assert scenario.initial_std[:2] == (0.2, 0.2) and scenario.detection_probability == 1.0
