"""Several vehicles in one ROS domain: each has what it would have alone."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dopslam_ros.bag import BagReader, BagWriter, deserialize, serialize
from dopslam_ros.messages import topics
from dopslam_ros.offline.replay import replay
from dopslam_ros.simulation.recording import write_simulation
from dopslam_ros.simulation.scenario import load_scenario

if TYPE_CHECKING:
    from tests.conftest import LiveRun, Process, Processes

STEPS, START = 8, 1.0
SEEDS = {"car1": 5, "car2": 6}
LAST = (topics.UE_STATE, topics.LANDMARK_MARKERS, topics.BOUNDS)


def start(processes: Processes, vehicle: str, bag: Path, scene: Path) -> list[Process]:
    """The four nodes of a vehicle, set as in the live run of the fixture but for the seed."""
    frames = {"map_frame": "world", "base_frame": "m"}
    unpaced = {"path_period": 0.0, "path_spacing": 0.0, "markers_period": 0.0}
    where = ("-r", f"__ns:=/{vehicle}")
    return [
        processes.node("recorder", *where, bag=bag),
        processes.node("filter", *where, **frames, **unpaced),
        processes.node("bounds", *where, map_frame="world"),
        processes.node(
            "simulator",
            *where,
            scenario=scene,
            seed=SEEDS[vehicle],
            rate=20.0,
            start_time=START,
            exit_when_done=False,
            wait_for_nodes="filter,bounds,recorder",
            **frames,
        ),
    ]


def recorded(bag: Path, vehicle: str) -> int:
    """Sets whose every answer is in a bag that may still be written."""
    try:
        found = BagReader(bag).topics
    except Exception:  # it has hardly begun
        return 0
    names = [f"/{vehicle}/{topic.name}" for topic in LAST]
    return min(found[name].message_count if name in found else 0 for name in names)


def test_two_vehicles_in_one_domain(
    processes: Processes,
    tmp_path: Path,
    scene: Path,
    live: LiveRun,
    wait: Callable[..., None],
    bag_payloads: Callable[..., list[bytes]],
) -> None:
    """Eight processes, two bags: each has its own vehicle alone, as if there were no other."""
    bags = {vehicle: tmp_path / vehicle for vehicle in SEEDS}
    nodes = [node for name, bag in bags.items() for node in start(processes, name, bag, scene)]
    wait(lambda: all(recorded(bag, name) == STEPS for name, bag in bags.items()), 120.0)
    for node in nodes:
        assert node.stop() == 0, node.stderr
        assert "refused" not in node.stderr
    for vehicle, bag in bags.items():
        check_topics(vehicle, bag)
    # The first is, byte for byte, what the same nodes without namespace and company said.
    for topic in (*topics.INPUTS, *topics.OUTPUTS):
        assert bag_payloads(bags["car1"], topic, "/car1/") == live.heard[topic.name], topic.name
    # The second heard what its seed gives offline, and said what a replay of that says.
    with BagWriter(tmp_path / "alone", flush_seconds=None) as writer:
        write_simulation(load_scenario(scene), SEEDS["car2"], writer)
    for topic in (topics.CHANNEL_MEASUREMENTS, topics.TRUTH_UE, topics.ODOMETRY_CONTROL):
        ours = bag_payloads(bags["car2"], topic, "/car2/")
        alone = bag_payloads(tmp_path / "alone", topic)
        assert without_frame(ours, topic) == without_frame(alone, topic), topic.name
    with BagWriter(tmp_path / "again", flush_seconds=None) as writer:
        assert not replay(BagReader(bags["car2"]), writer=writer).problems
    for topic in topics.OUTPUTS[1:]:
        again = bag_payloads(tmp_path / "again", topic, "/car2/")
        assert bag_payloads(bags["car2"], topic, "/car2/") == again, topic.name


def without_frame(payloads: list[bytes], topic: topics.Topic) -> list[bytes]:
    """The same messages without the names of frames, which were chosen for the live run."""
    messages: list[Any] = [deserialize(payload, topic.type_name) for payload in payloads]
    for message in messages:
        message.header.frame_id = ""
    return [serialize(message, topic.type_name) for message in messages]


def check_topics(vehicle: str, bag: Path) -> None:
    """Every topic of the vehicle, none of another; the diagnostics say whose they are."""
    reader = BagReader(bag)
    own = {f"/{vehicle}/{t.name}" for t in topics.RECORDED if t != topics.DIAGNOSTICS}
    assert set(reader.topics) == {*own, topics.DIAGNOSTICS.name}
    messages: list[Any] = [
        deserialize(message.payload, message.type_name)
        for message in reader.messages({topics.DIAGNOSTICS.name})
    ]
    told = {status.name for message in messages for status in message.status}
    assert {f"/{vehicle}/filter", f"/{vehicle}/simulator", f"/{vehicle}/bounds"} <= told
