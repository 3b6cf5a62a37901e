"""Scenario files: what is read, what is inherited, and what the errors say."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import yaml

from dopslam_ros.core.models.motion import Control
from dopslam_ros.core.settings.layout import LandmarkType
from dopslam_ros.simulation.scenario import Blockage, ScenarioError, load_scenario, parse_scenario

SMALL = """
controls:
  - {steps: 2, speed: 10, turn_rate: 0.0}
  - {steps: 1, speed: -3.5, turn_rate: 0.2}
landmarks:
  - {type: VA, position: [200, 0.0, 40.0]}
  - {type: SP, position: [1.0, 2.0, 3.0]}
period: 0.25
detection_probability: 1
measurement_noise_std: [0.1, 0.05, .nan, 0.05, .nan, .nan]
"""


def file_of(folder: Path, text: str) -> Path:
    path = folder / "scene.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def test_the_scene_of_the_paper() -> None:
    scenario = load_scenario("paper")
    assert scenario.steps == 40 and scenario.period == 0.5
    assert set(scenario.controls) == {Control(22.22, math.pi / 10.0)}
    assert scenario.bs_position == (0.0, 0.0, 40.0)
    vas = scenario.landmarks[scenario.landmark_types == LandmarkType.VA]
    sps = scenario.landmarks[scenario.landmark_types == LandmarkType.SP]
    turns = [[1, 0], [-1, 0], [0, 1], [0, -1]]
    np.testing.assert_array_equal(vas, [[200 * x, 200 * y, 40] for x, y in turns])
    np.testing.assert_array_equal(sps, [[99 * x, 99 * y, 10] for x, y in turns])
    assert scenario.initial_state == (70.7285, 0.0, math.pi / 2.0, 300.0)
    np.testing.assert_allclose(np.diag(scenario.noise)[:5], [0.01, *[2.5e-3] * 4])
    np.testing.assert_allclose(
        scenario.noise_rate * scenario.period, [0.2**2, 0.2**2, 0.001**2, 0.2**2]
    )


def test_a_file_is_read_and_the_rest_keeps_its_default(tmp_path: Path) -> None:
    scenario = load_scenario(file_of(tmp_path, SMALL))
    assert scenario.controls == (Control(10.0, 0.0),) * 2 + (Control(-3.5, 0.2),)
    assert scenario.landmark_types.tolist() == [1, 2]
    assert scenario.period_ns == 250_000_000
    assert scenario.stamp_ns(2) - scenario.stamp_ns(0) == 500_000_000
    assert scenario.detection_probability == 1.0
    assert scenario.used_components.tolist() == [True, True, False, True, False, False]
    assert scenario.sp_field_of_view == 50.0


@pytest.mark.parametrize("base", ["paper", "paper_bounds"])
def test_a_base_is_inherited(tmp_path: Path, base: str) -> None:
    text = f"base: {base}\nname: mine\nclutter_mean: 3.0\n"
    scenario, original = load_scenario(file_of(tmp_path, text)), load_scenario(base)
    assert scenario.name == "mine" and scenario.clutter_mean == 3.0
    assert scenario.initial_std == original.initial_std
    assert scenario.controls == original.controls
    np.testing.assert_array_equal(scenario.landmarks, original.landmarks)


def test_blockages_are_read_and_hold_up_to_their_end(tmp_path: Path) -> None:
    text = (
        SMALL.replace("steps: 2", "steps: 7")
        + "blocked:\n"
        + "  - {landmark: BS, from: 0.5, to: 1.25}\n"
        + "  - {landmark: 2, from: 0, to: 0.3}\n"
        + "  - {landmark: 2, from: 1.0, to: 1.1}\n"
    )
    scenario = load_scenario(file_of(tmp_path, text))
    assert scenario.blocked[:2] == (Blockage(0, 0.5, 1.25), Blockage(2, 0.0, 0.3))
    # Snapshots at 0, 0.25, ... s: the BS at 0.5 ... 1.0 s, the SP at 0, 0.25 and 1.0 s.
    table = np.array([scenario.blocked_at(step) for step in range(scenario.steps)])
    assert table.shape == (8, 3)
    assert np.flatnonzero(table[:, 0]).tolist() == [2, 3, 4]
    assert not table[:, 1].any()
    assert np.flatnonzero(table[:, 2]).tolist() == [0, 1, 4]
    assert load_scenario("paper").blocked == ()


def test_a_time_between_two_floats_is_still_the_snapshot() -> None:
    # 3 * 0.1 is more than 0.3 in binary: in whole nanoseconds it is not.
    controls = [{"steps": 6, "speed": 1.0, "turn_rate": 0.0}]
    blocked = [{"landmark": "BS", "from": 0.1, "to": 0.3}]
    scenario = parse_scenario({"period": 0.1, "controls": controls, "blocked": blocked})
    assert [scenario.blocked_at(step).tolist() for step in range(5)] == [
        [False],
        [True],
        [True],
        [False],
        [False],
    ]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"clutter_men": 1.0}, ["clutter_men", "did you mean 'clutter_mean'"]),
        ({"detection_probability": 1.5}, ["detection_probability", "1.5", "0 .. 1"]),
        ({"period": "fast"}, ["period", "'fast'", "number"]),
        ({"period": 0.0}, ["period", "0.0"]),
        ({"seed": 1.5}, ["seed", "1.5", "whole"]),
        ({"seed": -1}, ["seed", "-1"]),
        ({"initial_std": [1.0, 1.0]}, ["initial_std", "4 numbers, not 2"]),
        ({"initial_std": [0.3, 0.3, -1.0, 0.3]}, ["initial_std", "-1.0"]),
        ({"initial_state": [0.0, 0.0, math.nan, 0.0]}, ["initial_state", "nan"]),
        ({"clutter_path_length": [700.0, 300.0]}, ["clutter_path_length", "smaller number first"]),
        ({"landmarks": {"VA": 1}}, ["landmarks", "list"]),
        ({"landmarks": [{"type": "BS", "position": [0, 0, 0]}]}, ["landmark 1 of 1", "'BS'"]),
        ({"landmarks": [{"type": "VA"}]}, ["landmark 1 of 1", "'position' is missing"]),
        (
            {"landmarks": [{"type": "VA", "position": [0, 0]}]},
            ["landmark 1 of 1", "[0, 0]", "3 numbers"],
        ),
        (
            {"landmarks": [{"type": "VA", "position": [0, 0, math.inf]}]},
            ["landmark 1 of 1", "inf", "finite"],
        ),
        (
            {"landmarks": [{"type": "VA", "positon": [0, 0, 0]}]},
            ["landmark 1 of 1", "'positon'", "did you mean 'position'"],
        ),
        ({"landmarks": ["VA"]}, ["landmark 1 of 1", "'VA'"]),
        ({"controls": []}, ["controls", "list"]),
        ({"controls": None}, ["controls", "list"]),
        (
            {"controls": [{"steps": 0, "speed": 1.0, "turn_rate": 0.0}]},
            ["control 1 of 1", "steps 0"],
        ),
        (
            {"controls": [{"steps": 2.5, "speed": 1.0, "turn_rate": 0.0}]},
            ["control 1 of 1", "steps 2.5"],
        ),
        ({"controls": [{"steps": 2, "speed": 1.0}]}, ["control 1 of 1", "'turn_rate' is missing"]),
        (
            {"controls": [{"steps": 2, "speed": "x", "turn_rate": 0.0}]},
            ["control 1 of 1", "'x'", "finite"],
        ),
        ({"blocked": {"landmark": "BS"}}, ["blocked", "list"]),
        ({"blocked": None}, ["blocked", "list"]),
        ({"blocked": ["BS"]}, ["blockage 1 of 1", "'BS'", "landmark, from, to"]),
        (
            {"blocked": [{"landmark": "VA", "from": 0.0, "to": 1.0}]},
            ["blockage 1 of 1", "'VA'", "BS or", "2 landmarks"],
        ),
        (
            {"blocked": [{"landmark": 3, "from": 0.0, "to": 1.0}]},
            ["blockage 1 of 1", "landmark 3", "2 landmarks"],
        ),
        (
            {"blocked": [{"landmark": 0, "from": 0.0, "to": 1.0}]},
            ["blockage 1 of 1", "landmark 0", "BS"],
        ),
        (
            {"blocked": [{"landmark": True, "from": 0.0, "to": 1.0}]},
            ["blockage 1 of 1", "landmark True"],
        ),
        (
            {"blocked": [{"landmark": "BS", "from": 5.0, "to": 5.0}]},
            ["blockage 1 of 1", "5", "earlier time first"],
        ),
        (
            {"blocked": [{"landmark": "BS", "from": -1.0, "to": 5.0}]},
            ["blockage 1 of 1", "-1", "since the first snapshot"],
        ),
        (
            {"blocked": [{"landmark": "BS", "from": 1.0, "to": math.inf}]},
            ["blockage 1 of 1", "inf", "finite"],
        ),
        (
            {"blocked": [{"landmark": "BS", "from": 1.0}]},
            ["blockage 1 of 1", "'to' is missing"],
        ),
        (
            {"blocked": [{"landmark": "BS", "form": 1.0, "to": 2.0}]},
            ["blockage 1 of 1", "'form'", "did you mean 'from'"],
        ),
    ],
)
def test_errors_name_the_key_and_the_value(
    tmp_path: Path, change: dict[str, object], words: list[str]
) -> None:
    text = yaml.safe_dump({**yaml.safe_load(SMALL), **change})
    path = file_of(tmp_path, text)
    with pytest.raises(ScenarioError) as caught:
        load_scenario(path)
    for word in [*words, "scene.yaml"]:
        assert word in str(caught.value)


@pytest.mark.parametrize("content", [None, 3, "text", ["a", "b"]])
def test_a_file_that_holds_no_scene(content: object) -> None:
    with pytest.raises(ScenarioError, match="top level"):
        parse_scenario(content)


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match=r"nothing\.yaml.*cannot be read"):
        load_scenario(tmp_path / "nothing.yaml")
    with pytest.raises(ScenarioError, match="is not YAML"):
        load_scenario(file_of(tmp_path, "controls: [{steps: 1"))
    binary = tmp_path / "binary.yaml"
    binary.write_bytes(b"\xff\xfe\x00\x81")
    with pytest.raises(ScenarioError, match="binary"):
        load_scenario(binary)


def test_unknown_scenes_and_bases_suggest_the_nearest(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match="did you mean 'paper'"):
        load_scenario("papr")
    with pytest.raises(ScenarioError, match="did you mean 'paper_bounds'"):
        load_scenario(file_of(tmp_path, "base: paper_bound\n"))
