"""The filter node's state: maps, reset, pause, and going on after a kill."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from dopslam_msgs.srv import LoadMap, SaveMap
from std_srvs.srv import SetBool, Trigger

from dopslam_ros.bag import BagReader, BagWriter, deserialize
from dopslam_ros.core.session.checkpoint import SNAPSHOT
from dopslam_ros.messages import topics
from dopslam_ros.nodes.errors import StartError
from dopslam_ros.nodes.filter import FilterNode
from dopslam_ros.nodes.middleware import Output, middleware_class, qos_profile
from dopslam_ros.nodes.recorder import RecorderNode
from dopslam_ros.offline.replay import replay
from dopslam_ros.system.storage import read_checkpoint

if TYPE_CHECKING:
    from tests.conftest import Listener, Process, Processes, Ros

INPUTS = (topics.CHANNEL_MEASUREMENTS, topics.ODOMETRY_CONTROL)


class Vehicle:
    """Sends the sets and controls of a bag, one pair after the other, and calls services."""

    def __init__(self, ros: Ros, bag: Path) -> None:
        self._ros = ros
        self.node = ros.node("vehicle")
        self._outputs = {
            topic: Output(
                self.node.create_publisher(
                    middleware_class(topic.type_name), topic.name, qos_profile(topic.qos)
                ),
                topic.type_name,
            )
            for topic in INPUTS
        }
        reader = BagReader(bag)
        self.inputs: dict[topics.Topic, list[Any]] = {
            topic: [
                deserialize(m.payload, m.type_name) for m in reader.messages({"/" + topic.name})
            ]
            for topic in INPUTS
        }

    def join(self, gone: Iterable[bytes] = ()) -> None:
        """Waits until nothing that is sent can be lost to a filter.

        Args:
            gone: ``filters`` that were killed: the middleware takes a while to miss them.
        """
        publishers = [output.publisher for output in self._outputs.values()]

        def joined() -> bool:
            others = self.filters() - set(gone)
            counts = [p.get_subscription_count() for p in publishers]
            return bool(others) and min(counts) >= len(self.filters())

        self._ros.spin_until(joined)

    def filters(self) -> set[bytes]:
        """What tells those who listen to the controls, which a filter does last, apart."""
        name = topics.ODOMETRY_CONTROL.name
        return {bytes(i.endpoint_gid) for i in self.node.get_subscriptions_info_by_topic(name)}

    def send(self, first: int, last: int) -> None:
        """The snapshots first ... last - 1."""
        for number in range(first, last):
            for topic in INPUTS:
                self._outputs[topic].publish(self.inputs[topic][number])

    def stamp(self, number: int) -> int:
        """Time of a set [ns]."""
        at = self.inputs[topics.CHANNEL_MEASUREMENTS][number].header.stamp
        return int(at.sec) * 10**9 + int(at.nanosec)

    def call(self, kind: Any, service: str, **values: object) -> Any:
        """Calls a service of the filter; its response."""
        client = self.node.create_client(kind, f"filter/{service}")
        self._ros.spin_until(client.service_is_ready)
        future = client.call_async(kind.Request(**values))
        self._ros.spin_until(future.done)
        self.node.destroy_client(client)
        return future.result()


@pytest.fixture
def vehicle(ros: Ros, simulated: Path) -> Vehicle:
    """One that has the simulated bag to send."""
    return Vehicle(ros, simulated)


def arrived(ros: Ros, listener: Listener, count: int) -> list[bytes]:
    """The states so far, as soon as there are that many."""
    ros.spin_until(lambda: listener.count(topics.UE_STATE) >= count)
    return listener.bytes(topics.UE_STATE)


def test_services_change_the_run_and_its_replay(
    ros: Ros, vehicle: Vehicle, tmp_path: Path, bag_payloads: Callable[..., list[bytes]]
) -> None:
    """Save, load, reset and pause in a recorded run; the replay does the same, byte for byte."""
    bag, maps = tmp_path / "bag", tmp_path / "maps"
    recorder = ros.start(RecorderNode, bag=str(bag))
    node = ros.start(FilterNode, map_directory=str(maps))
    listener = ros.listen(topics.UE_STATE, topics.FILTER_EVENTS)
    vehicle.join()
    vehicle.send(0, 3)
    arrived(ros, listener, 3)
    saved = vehicle.call(SaveMap, "save_map", name="hall")
    assert saved.success and saved.path == str(maps / "hall.dopmap"), saved.message
    assert read_checkpoint(Path(saved.path)).stamp_ns == vehicle.stamp(2)
    assert vehicle.call(Trigger, "reset").success
    vehicle.send(3, 4)
    arrived(ros, listener, 4)
    loaded = vehicle.call(LoadMap, "load_map", name="hall.dopmap")
    assert loaded.success and loaded.path == saved.path, loaded.message
    vehicle.send(4, 5)
    arrived(ros, listener, 5)
    assert vehicle.call(SetBool, "pause", data=True).success
    vehicle.send(5, 7)
    ros.spin_until(lambda: node.problems["paused"] == 2)
    assert dict(node.health()[2])["paused"] is True
    assert vehicle.call(SetBool, "pause", data=False).success
    assert vehicle.call(SetBool, "pause", data=False).message == "not paused"
    vehicle.send(7, 8)
    live = arrived(ros, listener, 6)
    kinds = [event.kind for event in listener.messages(topics.FILTER_EVENTS)]
    assert kinds == ["reset", "load_map", "pause", "continue"]
    ros.spin_until(lambda: recorder._written >= 16 + 6 * 4 + 4)
    for each in (node, recorder):
        ros.remove(each)

    with BagWriter(tmp_path / "again", flush_seconds=None) as writer:
        run = replay(BagReader(bag), writer=writer)
    assert run.problems["paused"] == 2
    assert bag_payloads(tmp_path / "again", topics.UE_STATE) == live
    assert len(bag_payloads(tmp_path / "again", topics.FILTER_EVENTS)) == 4
    with BagWriter(tmp_path / "third", flush_seconds=None) as writer:
        replay(BagReader(tmp_path / "again"), writer=writer)
    assert bag_payloads(tmp_path / "third", topics.UE_STATE) == live


def test_a_service_never_leads_out_of_the_folder_and_never_ends_the_node(
    ros: Ros, vehicle: Vehicle, tmp_path: Path
) -> None:
    maps = tmp_path / "maps"
    maps.mkdir()
    (maps / "bad.dopmap").write_bytes(b"DOPSTATE" + bytes(100))
    (tmp_path / "outside.dopmap").write_bytes(b"secret")
    (maps / "link.dopmap").symlink_to(tmp_path / "outside.dopmap")
    node = ros.start(FilterNode, map_directory=str(maps))
    for name in ("../outside", "/etc/passwd", "a/b", "", "bad", "link", "missing"):
        answer = vehicle.call(LoadMap, "load_map", name=name)
        assert not answer.success and answer.message and not answer.path, name
    for name in ("../outside", "/tmp/x", ""):
        answer = vehicle.call(SaveMap, "save_map", name=name)
        assert not answer.success and "no name" in answer.message, name
    assert node.problems["service_refused"] == 10
    assert (tmp_path / "outside.dopmap").read_bytes() == b"secret"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["maps", "outside.dopmap"]
    listener = ros.listen(topics.UE_STATE)
    vehicle.join()
    vehicle.send(0, 1)
    arrived(ros, listener, 1)


def test_a_filter_localises_in_the_map_it_is_started_with(
    ros: Ros, vehicle: Vehicle, tmp_path: Path
) -> None:
    maps = tmp_path / "maps"
    first = ros.start(FilterNode, map_directory=str(maps))
    listener = ros.listen(topics.UE_STATE, topics.LANDMARKS)
    vehicle.join()
    vehicle.send(0, 8)
    learned = arrived(ros, listener, 8)
    assert vehicle.call(SaveMap, "save_map", name="hall").success
    ros.remove(first)
    ros.start(FilterNode, map_directory=str(maps), map="hall", mapping=False)
    vehicle.join()
    vehicle.send(0, 8)
    known = arrived(ros, listener, 16)[8:]
    assert known != learned
    before = (maps / "hall.dopmap").read_bytes()
    assert vehicle.call(SaveMap, "save_map", name="again").success
    assert (maps / "again.dopmap").read_bytes() == before
    with pytest.raises(StartError, match="bs_position"):
        ros.start(FilterNode, map_directory=str(maps), map="hall", bs_position=[0.0, 0.0, 41.0])
    with pytest.raises(StartError, match=r"missing\.dopmap"):
        ros.start(FilterNode, map_directory=str(maps), map="missing")
    with pytest.raises(StartError, match="name of a 'snapshot'"):
        ros.start(FilterNode, map_directory=str(maps), resume=True)


def resumable(processes: Processes, maps: Path) -> Process:
    """A filter in a process of its own that can be killed."""
    process = processes.node(
        "filter", map_directory=maps, snapshot="last", snapshot_period=0.05, resume=True
    )
    process.wait_for("ready")
    return process


def test_a_killed_filter_goes_on_where_it_was(
    processes: Processes, simulated: Path, tmp_path: Path
) -> None:
    """SIGKILL; the next process gives the same bytes for all sets after the snapshot."""
    from tests.conftest import Ros

    whole = [m.payload for m in _states(simulated, tmp_path / "whole")]
    maps = tmp_path / "maps"
    ros = Ros(processes.domain)
    try:
        vehicle = Vehicle(ros, simulated)
        listener = ros.listen(topics.UE_STATE)
        first = resumable(processes, maps)
        assert "starting anew" in first.stderr
        vehicle.join()
        vehicle.send(0, 5)
        assert arrived(ros, listener, 5) == whole[:5]
        path = maps / "last.dopstate"
        ros.spin_until(lambda: path.exists() and read_checkpoint(path).stamp_ns == vehicle.stamp(4))
        gone = vehicle.filters()
        assert first.stop(signal.SIGKILL) == -signal.SIGKILL
        second = resumable(processes, maps)
        assert "going on from" in second.stderr
        vehicle.join(gone)
        vehicle.send(5, 8)
        assert arrived(ros, listener, 8)[5:] == whole[5:]
        assert second.stop() == 0
        assert read_checkpoint(path).stamp_ns == vehicle.stamp(7)
    finally:
        ros.close()


def _states(bag: Path, out: Path) -> Any:
    with BagWriter(out, flush_seconds=None) as writer:
        replay(BagReader(bag), writer=writer)
    return BagReader(out).messages({f"/{topics.UE_STATE.name}"})


@pytest.mark.parametrize("trouble", ["damaged", "other", "old"])
def test_a_snapshot_that_is_no_good_is_told_and_left(
    ros: Ros, vehicle: Vehicle, tmp_path: Path, trouble: str
) -> None:
    maps = tmp_path / "maps"
    options: dict[str, Any] = {"map_directory": str(maps), "snapshot": "last", "resume": True}
    first = ros.start(FilterNode, **options)
    listener = ros.listen(topics.UE_STATE)
    vehicle.join()
    vehicle.send(0, 3)
    states = arrived(ros, listener, 3)
    ros.remove(first)
    path = maps / "last.dopstate"
    assert read_checkpoint(path).kind == SNAPSHOT
    if trouble == "damaged":
        data = bytearray(path.read_bytes())
        data[len(data) // 2] ^= 1
        path.write_bytes(data)
    elif trouble == "other":
        options["gamma"] = 9  # of no matter
        options["coupling"] = "marginal"
    else:
        options["resume_age"] = 0.0
        time.sleep(0.01)
    second = ros.start(FilterNode, **options)
    assert second.problems["resume_failed"] == 1
    vehicle.join()
    vehicle.send(0, 3)
    again = arrived(ros, listener, 6)[3:]
    assert (again == states) == (trouble != "other")
