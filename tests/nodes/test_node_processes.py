"""The nodes as processes of their own: any order of start, clean ends, the same results."""

from __future__ import annotations

import signal
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from dopslam_ros.bag import BagReader
from dopslam_ros.messages import topics

if TYPE_CHECKING:
    from tests.conftest import LiveRun, Process, Processes

STEPS, SEED, START = 8, 5, 1.0
ORDERS = (
    ("simulator", "bounds", "recorder", "filter"),
    ("recorder", "filter", "bounds", "simulator"),
    ("filter", "simulator", "recorder", "bounds"),
)


def start(processes: Processes, name: str, bag: Path, scene: Path) -> Process:
    """One of the four nodes, set as in the live run of the fixture."""
    parameters: dict[str, dict[str, object]] = {
        "simulator": {
            "scenario": scene,
            "seed": SEED,
            "rate": 50.0,
            "start_time": START,
            "exit_when_done": False,
            "wait_for_nodes": "filter,bounds,recorder",
            "map_frame": "world",
            "base_frame": "m",
        },
        "filter": {
            "map_frame": "world",
            "base_frame": "m",
            "path_period": 0.0,
            "path_spacing": 0.0,
            "markers_period": 0.0,
        },
        "bounds": {"map_frame": "world"},
        "recorder": {"bag": bag},
    }
    return processes.node(name, **parameters[name])


def recorded(bag: Path, topic: topics.Topic) -> int:
    """Messages of a topic in a bag that may still be written."""
    try:
        info = BagReader(bag).topics.get("/" + topic.name)
    except Exception:  # it has hardly begun
        return 0
    return info.message_count if info else 0


@pytest.mark.parametrize("order", ORDERS, ids="-".join)
def test_separate_processes_in_any_order(
    processes: Processes,
    tmp_path: Path,
    scene: Path,
    live: LiveRun,
    bag_payloads: Callable[..., list[bytes]],
    wait: Callable[..., None],
    order: tuple[str, ...],
) -> None:
    """Whoever starts first, the bag is that of one process; Ctrl-C ends each one cleanly."""
    bag = tmp_path / "bag"
    nodes = {name: start(processes, name, bag, scene) for name in order}
    wait(lambda: min(recorded(bag, t) for t in (topics.LANDMARK_MARKERS, topics.BOUNDS)) == STEPS)
    # In the order of a user who is in a hurry: the recorder is not the last.
    for name in ("recorder", "filter", "bounds", "simulator"):
        assert nodes[name].stop(signal.SIGINT) == 0, nodes[name].stderr
        assert "Traceback" not in nodes[name].stderr
        assert "refused" not in nodes[name].stderr
    assert BagReader(bag).damage is None
    assert (bag / "metadata.yaml").is_file()
    for topic in (*topics.INPUTS, *topics.OUTPUTS):
        assert bag_payloads(bag, topic) == live.heard[topic.name], topic.name


@pytest.mark.usefixtures("in_background")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_every_node_ends_cleanly_on_a_signal(
    processes: Processes, tmp_path: Path, simulated: Path, scene: Path, number: signal.Signals
) -> None:
    """All five, idle or waiting: exit 0 and no traceback, on SIGINT and on a kill.

    Also where they have inherited that SIGINT is ignored: it is how a launch file stops its nodes.
    """
    nodes = {
        "simulator": processes.node("simulator", scenario=scene, wait_for_nodes="nobody"),
        "filter": processes.node("filter"),
        "bounds": processes.node("bounds"),
        "recorder": processes.node("recorder", bag=tmp_path / "bag"),
        "player": processes.node("player", bag=simulated, wait_for_nodes="nobody"),
    }
    for process in nodes.values():
        process.wait_for("ready")
    for process in nodes.values():
        process.popen.send_signal(number)
    for name, process in nodes.items():
        assert process.wait() == 0, f"{name}: {process.stderr}"
        assert "Traceback" not in process.stderr, name


def test_a_signal_while_starting(processes: Processes, tmp_path: Path) -> None:
    """Ctrl-C right after the log began: the bag, if there is one, is whole."""
    recorder = processes.node("recorder", bag=tmp_path / "bag")
    recorder.wait_for("bag:")
    assert recorder.stop() == 0, recorder.stderr
    assert "Traceback" not in recorder.stderr
    assert BagReader(tmp_path / "bag").damage is None


def test_the_simulator_ends_by_itself(processes: Processes, scene: Path) -> None:
    """After the last snapshot the simulator exits with 0 and says how many it sent."""
    process = processes.node("simulator", scenario=scene, rate=100.0, wait_for_nodes="''")
    assert process.wait() == 0, process.stderr
    assert f"done: {STEPS} snapshots sent" in process.stderr
