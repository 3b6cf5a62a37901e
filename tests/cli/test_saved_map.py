"""Maps on the command line: learned in one replay, described, localised in by the next."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from dopslam_ros.bag import BagReader
from dopslam_ros.cli.main import main
from dopslam_ros.core.pmb import FilterParameters
from dopslam_ros.core.session.filtering import FilterSession
from dopslam_ros.messages import topics
from dopslam_ros.simulation.scenario import load_scenario
from dopslam_ros.simulation.simulator import all_landmarks
from dopslam_ros.system.storage import read_checkpoint, write_checkpoint

PAPER = Path(__file__).resolve().parents[2] / "bags" / "paper"


@pytest.fixture(scope="module")
def hall(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The map of the reference run."""
    path = tmp_path_factory.mktemp("maps") / "hall.dopmap"
    assert main(["replay", str(PAPER), "--save-map", str(path)]) == 0
    return path


def test_a_map_is_described(hall: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["map", str(hall), "--json", str(tmp_path / "map.json")]) == 0
    printed = capsys.readouterr().out
    assert "checksum ok" in printed and "version 1" in printed
    about = json.loads((tmp_path / "map.json").read_text())
    assert about["kind"] == "map" and about["parameters"]["coupling"] == "joint"
    positions, _ = all_landmarks(load_scenario("paper"))
    assert {one["type"] for one in about["landmarks"]} == {"VA", "SP"}
    for one in about["landmarks"]:
        error = np.linalg.norm(positions - one["position"], axis=1).min()
        assert error < 4.0 * np.sqrt(np.trace(one["covariance"]))
        assert f"{one['position'][0]:.2f}" in printed


def test_a_replay_localises_in_a_map_and_leaves_it(
    hall: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    again, bag, result = tmp_path / "again.dopmap", tmp_path / "bag", tmp_path / "result.json"
    arguments = ["replay", str(PAPER), "--map", str(hall), "--param", "mapping=false"]
    more = ["--save-map", str(again), "--out", str(bag), "--json", str(result)]
    assert main([*arguments, *more]) == 0
    assert again.read_bytes() == hall.read_bytes()
    summary = json.loads(result.read_text())
    assert summary["steps"] == 40 and summary["nees_mean"] < 8.0
    # The new bag has the map in it: its replay needs no file.
    assert main(["replay", str(bag), "--save-map", str(tmp_path / "third.dopmap")]) == 0
    assert (tmp_path / "third.dopmap").read_bytes() == hall.read_bytes()
    states = {topic.name for topic in (topics.UE_STATE, topics.FILTER_EVENTS)}
    assert {"/" + name for name in states} <= set(BagReader(bag).topics)
    capsys.readouterr()


def test_a_snapshot_is_described_with_its_vehicle(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "last.dopstate"
    write_checkpoint(path, FilterSession(FilterParameters()).snapshot())
    assert main(["map", str(path)]) == 0
    printed = capsys.readouterr().out
    assert "snapshot before the first set" in printed
    assert "vehicle at 70.73, 0.00 m" in printed


@pytest.mark.parametrize(
    ("arguments", "code", "match"),
    [
        (["map", "missing.dopmap"], 1, "missing.dopmap' cannot be read"),
        (["map", str(PAPER / "metadata.yaml")], 1, "no map or snapshot"),
        (["replay", str(PAPER), "--map", str(PAPER / "metadata.yaml")], 1, "no map or snapshot"),
        (["replay", str(PAPER), "--save-map", "/no/folder/x.dopmap"], 2, "--save-map"),
    ],
)
def test_what_cannot_be_is_told(
    arguments: list[str], code: int, match: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments) == code
    assert match in capsys.readouterr().err


def test_a_map_of_another_base_station_is_told(
    hall: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = ["--param", "bs_position=[0.0, 0.0, 30.0]", "--map", str(hall)]
    assert main(["replay", str(PAPER), *other]) == 1
    assert "bs_position" in capsys.readouterr().err
    assert read_checkpoint(hall).kind == "map"
