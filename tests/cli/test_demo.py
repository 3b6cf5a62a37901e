"""The demo, as users start it: live, recorded, replayed, compared, drawn."""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import matplotlib.image
import numpy as np
import pytest

from dopslam_ros.bag import BagReader, BagWriter
from dopslam_ros.lab.demo import live_run
from dopslam_ros.lab.demo.comparison import difference
from dopslam_ros.messages import topics
from dopslam_ros.simulation.scenario import load_scenario
from dopslam_ros.system.processes import CLOSING_SECONDS, running

if TYPE_CHECKING:
    from tests.conftest import Process, Processes

STEPS = 8


def check_results(process: Process, parent: Path, payloads: Callable[..., list[bytes]]) -> Path:
    """Everything that the demo promises is there; its folder."""
    assert "Traceback" not in process.stderr
    assert "all vehicle states equal, byte for byte" in process.stdout
    (folder,) = parent.iterdir()
    live, again = folder / "live", folder / "replay"
    assert BagReader(live).damage is None and BagReader(again).damage is None
    for topic in (*topics.INPUTS, topics.UE_STATE, topics.LANDMARKS, topics.BOUNDS):
        recorded = payloads(live, topic)
        assert len(recorded) == (1 if topic == topics.TRUTH_LANDMARKS else STEPS)
        assert payloads(again, topic) == recorded, topic.name
    result = json.loads((folder / "result.json").read_text("utf-8"))
    assert result["steps"] == STEPS and 0.0 < result["position_rmse"] < 3.0
    assert f"{result['position_rmse']:.4f}" in process.stdout
    assert result["problems"] == {}
    page = (folder / "report.html").read_text("utf-8")
    assert str(folder / "report.html") in process.stdout and "<script" in page
    image = np.asarray(matplotlib.image.imread(folder / "run.png"))
    assert (image[..., :3] < 0.95).any(axis=2).mean() > 0.02
    for name in ("simulator", "filter", "bounds", "recorder"):
        log = (folder / f"{name}.log").read_text("utf-8")
        assert "ready" in log and "Traceback" not in log
    return folder


def test_two_demos_at_once(
    processes: Processes, tmp_path: Path, scene: Path, bag_payloads: Callable[..., list[bytes]]
) -> None:
    """Each ends with 0 and with all its results, and hears nothing of the other."""
    parents = [tmp_path / "first", tmp_path / "second"]
    asked = ("demo", "--scenario", scene, "--rate", 40)
    started = [
        processes.dopslam(*asked, "--seed", seed, "--out", parent, "--json", f"{parent}.json")
        for seed, parent in enumerate(parents)
    ]
    folders = []
    for process, parent in zip(started, parents, strict=True):
        assert process.wait() == 0, process.stderr
        folders.append(check_results(process, parent, bag_payloads))
        written = Path(f"{parent}.json").read_bytes()
        assert written == (folders[-1] / "result.json").read_bytes()
    first, second = (bag_payloads(f / "live", topics.CHANNEL_MEASUREMENTS) for f in folders)
    assert not set(first) & set(second)


def test_ctrl_c_ends_the_nodes(
    processes: Processes, tmp_path: Path, scene: Path, wait: Callable[..., None]
) -> None:
    """Ctrl-C in the middle: 130, no traceback, no node left behind, a bag that can be read."""
    process = processes.dopslam(
        "demo", "--scenario", scene, "--rate", 0.5, "--out", tmp_path / "runs"
    )

    def bag() -> Path | None:
        found = list(tmp_path.glob("runs/*/live"))
        return found[0] if found and live_run._recorded(found[0])[0] else None

    wait(bag)
    assert process.interrupt_all() == 130, process.stderr
    assert "Traceback" not in process.stderr
    found = bag()
    assert found is not None
    reader = BagReader(found)
    assert reader.damage is None
    assert 0 < reader.topics["/channel_measurements"].message_count < STEPS
    assert f"closed {found}" in (found.parent / "recorder.log").read_text("utf-8")


def test_a_node_that_dies_is_named(
    tmp_path: Path, scene: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """When a node cannot start the demo ends at once and says whose log to read."""
    monkeypatch.setattr(live_run, "PATIENCE", 60.0)
    (tmp_path / "live").mkdir()  # the recorder finds its bag's place taken
    with pytest.raises(
        live_run.DemoError, match=r"node recorder ended with code 2: see recorder\.log"
    ):
        live_run.run_live(str(scene), 1, 40.0, tmp_path, lambda done: None)
    assert "exists already" in (tmp_path / "recorder.log").read_text("utf-8")


@pytest.mark.usefixtures("in_background")
def test_in_the_background_a_process_that_has_hardly_begun_ends(tmp_path: Path) -> None:
    """It ignores Ctrl-C like the one who began it, and has no handlers of its own yet."""
    command = [sys.executable, "-c", f"import time; time.sleep({2 * CLOSING_SECONDS})"]
    started = time.monotonic()
    with running(command, tmp_path / "log", os.environ):
        pass
    assert time.monotonic() - started < CLOSING_SECONDS  # it did not have to be killed


def test_a_difference_is_found(simulated: Path, tmp_path: Path) -> None:
    """The comparison sees one changed byte, one message less, and equality."""
    topic, reader = "/truth/ue", BagReader(simulated)
    payloads = [m.payload for m in reader.messages({topic})]

    def bag(name: str, contents: list[bytes]) -> BagReader:
        with BagWriter(tmp_path / name) as writer:
            writer.add_topic(topic, topics.TRUTH_UE.type_name)
            for number, payload in enumerate(contents):
                writer.write(topic, payload, 10**9 + number)
        return BagReader(tmp_path / name)

    assert difference(reader, bag("same", payloads), topic) is None
    spoiled = [*payloads[:5], payloads[5][:-1] + b"\x01", *payloads[6:]]
    text = difference(reader, bag("other", spoiled), topic)
    assert text == f"1 of {STEPS} messages on {topic} differ, first: 5"
    text = difference(reader, bag("less", payloads[:-1]), topic)
    assert text == f"{STEPS} messages on {topic} live, {STEPS - 1} in the replay"


def test_no_results_are_overwritten(tmp_path: Path) -> None:
    """Runs within the same second get folders of their own; a bad place is an error."""
    scenario = load_scenario("paper")
    folders = {live_run.new_folder(tmp_path / "runs", scenario) for _ in range(4)}
    assert len(folders) == 4 and all(folder.is_dir() for folder in folders)
    assert all(folder.name.startswith("paper_") for folder in folders)
    (tmp_path / "file").touch()
    with pytest.raises(live_run.DemoError, match="cannot make the folder"):
        live_run.new_folder(tmp_path / "file", scenario)
