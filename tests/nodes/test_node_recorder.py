"""The recorder: everything that was published is in a bag that every tool can read."""

from __future__ import annotations

import itertools
import shutil
import signal
import subprocess
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
import yaml
from rosbags.highlevel import AnyReader

from dopslam_ros.bag import (
    BagReader,
    Durability,
    Reliability,
    message_class,
    serialize,
    type_hash,
    typestore,
)
from dopslam_ros.core.models.measurements import MeasurementSet
from dopslam_ros.core.models.motion import Control
from dopslam_ros.messages import topics
from dopslam_ros.messages.common import Frames
from dopslam_ros.messages.inputs import make_control, make_measurements
from dopslam_ros.nodes.errors import StartError
from dopslam_ros.nodes.filter import FilterNode
from dopslam_ros.nodes.middleware import middleware_class, qos_profile
from dopslam_ros.nodes.recorder import RecorderNode

if TYPE_CHECKING:
    from tests.conftest import LiveRun, Processes, Ros


def full_name(topic: topics.Topic) -> str:
    """The topic's name in a bag recorded without a namespace."""
    return "/" + topic.name.lstrip("/")


def test_the_bag_holds_every_message(
    live: LiveRun, bag_payloads: Callable[..., list[bytes]]
) -> None:
    """Every message of every topic is there, byte for byte and in the order it was heard."""
    for topic in topics.RECORDED:
        recorded = bag_payloads(live.bag, topic)
        assert Counter(recorded) == Counter(live.heard[topic.name]), topic.name
        if topic != topics.DIAGNOSTICS:  # those of several publishers may overtake each other
            assert recorded == live.heard[topic.name], topic.name
    assert BagReader(live.bag).damage is None


def test_offers_and_hashes_are_stored(live: LiveRun) -> None:
    """Per topic: the type, its hash and the quality of service that its publishers offered."""
    found = BagReader(live.bag).topics
    assert set(found) == {full_name(topic) for topic in topics.RECORDED}
    for topic in topics.RECORDED:
        info = found[full_name(topic)]
        assert info.type_name == topic.type_name
        assert info.type_hash == type_hash(topic.type_name)
        assert info.type_hash.startswith("RIHS01_")
        (qos,) = info.qos
        assert qos.reliability == Reliability.RELIABLE
        assert qos.durability == (
            Durability.TRANSIENT_LOCAL if topic.latched else Durability.VOLATILE
        ), topic.name


def test_hashes_are_those_of_the_middleware(ros: Ros, live: LiveRun) -> None:
    """The hash in the bag is the one that discovery reports for a publisher of the type."""

    node = ros.node("publisher")
    for topic in topics.RECORDED:
        node.create_publisher(middleware_class(topic.type_name), topic.name, 1)
    for topic in topics.RECORDED:
        (info,) = node.get_publishers_info_by_topic(full_name(topic))
        digest = "".join(f"{byte:02x}" for byte in info.topic_type_hash.value)
        stored = BagReader(live.bag).topics[full_name(topic)].type_hash
        assert stored == f"RIHS{info.topic_type_hash.version:02d}_{digest}"


def test_another_library_reads_the_bag(live: LiveRun) -> None:
    """The library rosbags opens the bag and finds the same messages, and can read each."""
    with AnyReader([live.bag], default_typestore=typestore()) as reader:
        counts = {c.topic: c.msgcount for c in reader.connections}
        assert counts == {full_name(t): len(live.heard[t.name]) for t in topics.RECORDED}
        for connection, _, payload in reader.messages():
            reader.deserialize(payload, connection.msgtype)


def test_the_definition_in_the_bag_is_enough(live: LiveRun) -> None:
    """The types can be read from the bag alone, as a viewer does that has none of our packages."""
    with AnyReader([live.bag]) as reader:
        names = {"/ue_state", "/channel_measurements", "/landmarks", "/bounds"}
        connections = [c for c in reader.connections if c.topic in names]
        assert {c.topic for c in connections} == names
        for connection, _, payload in reader.messages(connections):
            message = reader.deserialize(payload, connection.msgtype)
            assert message.header.stamp.sec > 0


def test_an_existing_folder_is_left_alone(ros: Ros, tmp_path: Path) -> None:
    """A bag is never overwritten: the node does not start and says which folder it is about."""
    folder = tmp_path / "taken"
    folder.mkdir()
    with pytest.raises(StartError, match=r"taken' exists already .* choose another name"):
        ros.start(RecorderNode, bag=str(folder))
    assert not list(folder.iterdir())


def test_extra_topics_are_found(ros: Ros, tmp_path: Path) -> None:
    """A topic named by the user is recorded with the type that its publisher has."""
    from std_msgs.msg import Float64

    recorder = ros.start(RecorderNode, bag=str(tmp_path / "bag"), extra_topics="speed, nobody")
    publisher = ros.node("car").create_publisher(Float64, "speed", 10)
    ros.spin_until(lambda: publisher.get_subscription_count() == 1)
    publisher.publish(Float64(data=3.5))
    ros.spin_until(lambda: dict(recorder.health()[2])["topics"] >= 2)
    ros.remove(recorder)
    info = BagReader(tmp_path / "bag").topics["/speed"]
    assert (info.type_name, info.message_count) == ("std_msgs/msg/Float64", 1)


def test_garbage_is_recorded_as_it_is(
    ros: Ros, tmp_path: Path, bag_payloads: Callable[..., list[bytes]]
) -> None:
    """The recorder does not look into messages: what cannot be read is kept for later."""

    recorder = ros.start(RecorderNode, bag=str(tmp_path / "bag"))
    topic = topics.CHANNEL_MEASUREMENTS
    publisher = ros.node("car").create_publisher(
        middleware_class(topic.type_name), topic.name, qos_profile(topic.qos)
    )
    ros.spin_until(lambda: publisher.get_subscription_count() == 1)
    publisher.publish(b"\0\1\0\0rubbish!")
    ros.spin_until(lambda: dict(recorder.health()[2])["topics"] >= 2)
    ros.remove(recorder)
    assert bag_payloads(tmp_path / "bag", topic) == [b"\0\1\0\0rubbish!"]


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system with room for 256 kB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=256k", "tmpfs", str(folder)]
    if not shutil.which("mount") or subprocess.run(command, check=False).returncode:
        pytest.skip("this user may not mount a file system")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


def test_a_full_disk_is_told_and_the_filter_runs_on(ros: Ros, small_disk: Path) -> None:
    """Diagnostics say ERROR with the reason, what was written is valid, sets are still filtered."""

    listener = ros.listen(topics.UE_STATE)
    filtering = ros.start(FilterNode)
    recorder = ros.start(RecorderNode, bag=str(small_disk / "bag"))
    car = ros.node("car")
    sets, controls = (
        car.create_publisher(middleware_class(t.type_name), t.name, qos_profile(t.qos))
        for t in (topics.CHANNEL_MEASUREMENTS, topics.ODOMETRY_CONTROL)
    )
    ros.spin_until(lambda: controls.get_subscription_count() == 2)
    ros.spin_until(lambda: sets.get_subscription_count() == 2)
    noise = np.random.default_rng(1)
    while recorder.health()[0] != 2:  # bytes that are no set: only the recorder takes them
        sets.publish(b"\0\1\0\0" + noise.bytes(10_000))
        ros.spin_until(lambda: filtering.problems["malformed_message"] > 0)
        filtering.problems.clear()
    level, text, values = recorder.health()
    assert (level, dict(values)["messages_lost"] > 0) == (2, True)
    assert "No space left on device" in text and "make room" in text
    for step in range(1, 4):
        nothing = MeasurementSet(np.zeros((0, 6)), np.zeros((0, 6, 6)))
        for topic, publisher, message in (
            (
                topics.ODOMETRY_CONTROL,
                controls,
                make_control(message_class, step * 10**9, Control(1.0, 0.0), Frames()),
            ),
            (
                topics.CHANNEL_MEASUREMENTS,
                sets,
                make_measurements(message_class, step * 10**9, nothing, Frames()),
            ),
        ):
            publisher.publish(serialize(message, topic.type_name))
    ros.spin_until(lambda: listener.count(topics.UE_STATE) == 3)
    reader = BagReader(small_disk / "bag")
    assert 10 < reader.message_count == sum(1 for _ in reader.messages())
    assert reader.damage is not None and "with 0 bytes that cannot be read" in reader.damage
    ros.remove(recorder)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_closes_the_bag(
    processes: Processes, ros: Ros, tmp_path: Path, number: signal.Signals
) -> None:
    """Ctrl-C or a kill in the middle of the stream: exit 0, no traceback, an indexed bag."""
    from rclpy.duration import Duration

    processes.domain = ros.domain
    bag = tmp_path / "bag"
    recorder = processes.node("recorder", bag=bag)
    recorder.wait_for("ready")
    topic = topics.ODOMETRY_CONTROL
    publisher = ros.node("car").create_publisher(
        middleware_class(topic.type_name), topic.name, qos_profile(topic.qos)
    )
    ros.spin_until(lambda: publisher.get_subscription_count() == 1)
    for step in range(300):
        message = make_control(message_class, 10**9 + step, Control(1.0, 0.0), Frames())
        publisher.publish(serialize(message, topic.type_name))
    assert publisher.wait_for_all_acked(Duration(seconds=5.0))
    if number == signal.SIGTERM:  # what is there is there while the recording goes on, too
        ros.spin_until(lambda: _count(bag, topic) > 0)
    assert recorder.stop(number) == 0, recorder.stderr
    assert "Traceback" not in recorder.stderr
    reader = BagReader(bag)
    assert reader.damage is None
    assert 0 < reader.topics["/odometry_control"].message_count <= 300
    metadata = yaml.safe_load((bag / "metadata.yaml").read_text("utf-8"))
    counted = metadata["rosbag2_bagfile_information"]["message_count"]
    assert counted == reader.message_count
    assert f"closed {bag}: {counted} messages" in recorder.stderr
    with AnyReader([bag], default_typestore=typestore()) as other:
        assert other.message_count == counted


def test_a_killed_recorder_loses_at_most_a_second(
    processes: Processes, ros: Ros, tmp_path: Path, wait: Callable[..., None]
) -> None:
    """SIGKILL in the middle of the stream; `dopslam recover` makes a bag of what was heard."""
    processes.domain = ros.domain
    bag, topic = tmp_path / "bag", topics.CHANNEL_MEASUREMENTS
    recorder = processes.node("recorder", bag=bag)
    recorder.wait_for("ready")
    publisher = ros.node("car").create_publisher(
        middleware_class(topic.type_name), topic.name, qos_profile(topic.qos)
    )
    ros.spin_until(lambda: publisher.get_subscription_count() == 1)
    paths = MeasurementSet(np.ones((10, 6)), np.zeros((10, 6, 6)))
    sent: dict[bytes, float] = {}

    def send() -> None:
        message = make_measurements(message_class, 10**9 + len(sent), paths, Frames())
        payload = serialize(message, topic.type_name)
        publisher.publish(payload)
        sent[payload] = time.monotonic()
        time.sleep(0.005)

    end = time.monotonic() + 2.5
    wait(lambda: time.monotonic() > end and _count(bag, topic) > 0, step=send)
    killed = time.monotonic()
    recorder.stop(signal.SIGKILL)
    assert BagReader(bag).damage is not None
    recovering = processes.dopslam("recover", bag, tmp_path / "saved")
    assert recovering.wait() == 0, recovering.stderr
    reader = BagReader(tmp_path / "saved")
    assert reader.damage is None
    found = [message.payload for message in reader.messages({full_name(topic)})]
    assert found == list(sent)[: len(found)]  # all of them, up to where it ends
    assert all(killed - at < 1.0 for at in list(sent.values())[len(found) :])
    with AnyReader([tmp_path / "saved"], default_typestore=typestore()) as other:
        assert other.message_count == reader.message_count


def test_what_the_middleware_lost_is_counted(
    processes: Processes, ros: Ros, tmp_path: Path
) -> None:
    """A recorder was held up while its publisher's queue ran over: it says how many are missing."""
    processes.domain = ros.domain
    bag, topic = tmp_path / "bag", topics.ODOMETRY_CONTROL
    listener = ros.listen(topics.DIAGNOSTICS)
    recorder = processes.node("recorder", bag=bag)
    recorder.wait_for("ready")
    publisher = ros.node("car").create_publisher(
        middleware_class(topic.type_name), topic.name, qos_profile(topic.qos)
    )
    ros.spin_until(lambda: publisher.get_subscription_count() == 1)
    numbers = itertools.count()

    def send(count: int) -> None:
        for _ in range(count):
            message = make_control(message_class, 10**9 + next(numbers), Control(1, 0), Frames())
            publisher.publish(serialize(message, topic.type_name))

    def told() -> dict[str, str]:
        statuses = [s for m in listener.messages(topics.DIAGNOSTICS) for s in m.status]
        return {v.key: v.value for v in statuses[-1].values} if statuses else {}

    send(10)
    ros.spin_until(lambda: _count(bag, topic) == 10)
    recorder.popen.send_signal(signal.SIGSTOP)
    send(3 * topic.depth)
    recorder.popen.send_signal(signal.SIGCONT)
    send(10)
    sent = next(numbers)
    ros.spin_until(lambda: _count(bag, topic) + int(told().get("messages_lost", 0)) == sent)
    assert int(told()["messages_lost"]) >= topic.depth
    assert told()["problem.lost_by_middleware"] == told()["messages_lost"]
    assert "lost_by_middleware" in recorder.stderr


def test_an_existing_folder_ends_the_process(processes: Processes, tmp_path: Path) -> None:
    """As a process: exit code 2 and one line that names the folder."""
    (tmp_path / "taken").mkdir()
    recorder = processes.node("recorder", bag=tmp_path / "taken")
    assert recorder.wait() == 2
    assert "Traceback" not in recorder.stderr
    lines = [line for line in recorder.stderr.splitlines() if line.startswith("error:")]
    assert len(lines) == 1 and "exists already" in lines[0]


def _count(bag: Path, topic: topics.Topic) -> int:
    info = BagReader(bag).topics.get(full_name(topic))
    return info.message_count if info else 0
