"""The player: a bag again as topics, at any pace, with the bag's time on /clock."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from dopslam_ros.bag import BagReader, BagWriter
from dopslam_ros.messages import topics
from dopslam_ros.nodes.errors import StartError
from dopslam_ros.nodes.filter import FilterNode
from dopslam_ros.nodes.middleware import middleware_class
from dopslam_ros.nodes.player import PlayerNode

if TYPE_CHECKING:
    from tests.conftest import LiveRun, Processes, Ros

STEPS = 8
SECOND = 1_000_000_000


def listen_to_clock(ros: Ros) -> list[int]:
    """The times on /clock [ns], as they come."""
    times: list[int] = []

    def note(message: Any) -> None:
        times.append(message.clock.sec * SECOND + message.clock.nanosec)

    ros.node("watch").create_subscription(
        middleware_class("rosgraph_msgs/msg/Clock"), "/clock", note, 1000
    )
    return times


def test_every_input_comes_again(ros: Ros, live: LiveRun) -> None:
    """What the filter and the bounds need is published byte for byte; their results are not."""
    listener = ros.listen(*topics.RECORDED)
    player = ros.start(PlayerNode, bag=str(live.bag), rate=200.0, wait_for_nodes="listener")
    ros.spin_until(player.finished)
    ros.spin_until(lambda: sum(listener.count(t) for t in topics.INPUTS) == 3 * STEPS + 1)
    for topic in topics.INPUTS:
        assert listener.bytes(topic) == live.heard[topic.name], topic.name
    for topic in topics.OUTPUTS:
        assert listener.count(topic) == 0, topic.name


def test_outputs_on_request(ros: Ros, live: LiveRun) -> None:
    """With `outputs` everything that was recorded is published."""
    listener = ros.listen(*topics.OUTPUTS, topics.ODOMETRY_CONTROL)
    player = ros.start(
        PlayerNode, bag=str(live.bag), rate=50.0, outputs=True, wait_for_nodes="listener"
    )
    ros.spin_until(player.finished)
    for topic in topics.OUTPUTS:
        count = len(live.heard[topic.name])
        ros.spin_until(lambda topic=topic, count=count: listener.count(topic) == count)
        assert listener.bytes(topic) == live.heard[topic.name], topic.name


def test_the_clock_never_runs_back(ros: Ros, live: LiveRun) -> None:
    """/clock is there from the first message on, increases, and ends with the bag's last."""
    times = listen_to_clock(ros)
    player = ros.start(PlayerNode, bag=str(live.bag), rate=1.0, wait_for_nodes="")
    ros.spin_until(lambda: player.count_subscribers("/clock") == 1)
    ros.spin_until(player.finished)
    reader = BagReader(live.bag)
    wanted = {"/" + t.name for t in topics.INPUTS}
    logged = [m.log_time_ns for m in reader.messages(wanted)]
    ros.spin_until(lambda: times and times[-1] >= logged[-1])
    assert times == sorted(times)
    assert logged[0] <= times[0] and times[-1] < logged[-1] + SECOND // 10
    assert len(set(times)) > len(set(logged)), "time passes between the messages too"
    assert set(logged) <= {*times, *logged[:3]}


def test_no_clock_on_request(ros: Ros, live: LiveRun) -> None:
    """With `clock` off nothing is said about the time."""
    times = listen_to_clock(ros)
    listener = ros.listen(topics.ODOMETRY_CONTROL)
    player = ros.start(
        PlayerNode, bag=str(live.bag), rate=100.0, clock=False, wait_for_nodes="listener"
    )
    ros.spin_until(player.finished)
    ros.spin_until(lambda: listener.count(topics.ODOMETRY_CONTROL) == STEPS)
    assert times == []


@pytest.mark.parametrize(("rate", "least", "most"), [(4.0, 0.8, 1.6), (40.0, 0.0, 0.5)])
def test_the_rate_is_kept(
    ros: Ros, simulated: Path, rate: float, least: float, most: float
) -> None:
    """3.5 s of bag take 3.5 s over the rate."""
    player = ros.start(PlayerNode, bag=str(simulated), rate=rate)
    ros.spin_until(lambda: dict(player.health()[2])["messages_published"] > 0)
    begin = time.monotonic()
    ros.spin_until(player.finished)
    assert least < time.monotonic() - begin < most


def test_paused_and_resumed(ros: Ros, simulated: Path) -> None:
    """While paused nothing is sent; after that everything is, and none of it is skipped."""
    from rclpy.parameter import Parameter

    listener = ros.listen(topics.CHANNEL_MEASUREMENTS, topics.ODOMETRY_CONTROL)
    player = ros.start(
        PlayerNode, bag=str(simulated), rate=100.0, paused=True, wait_for_nodes="listener"
    )
    other = ros.node("other")
    ticks: list[int] = []
    other.create_timer(0.05, lambda: ticks.append(1))
    ros.spin_until(lambda: len(ticks) >= 12)
    assert listener.count(topics.CHANNEL_MEASUREMENTS) == 0
    (result,) = player.set_parameters([Parameter("paused", value=False)])
    assert result.successful
    ros.spin_until(player.finished)
    for topic in (topics.CHANNEL_MEASUREMENTS, topics.ODOMETRY_CONTROL):
        ros.spin_until(lambda topic=topic: listener.count(topic) == STEPS)


def test_pause_at_end_keeps_the_map(ros: Ros, live: LiveRun) -> None:
    """The player stays, and who comes late gets the latched topics; without it, it is finished."""
    player = ros.start(PlayerNode, bag=str(live.bag), rate=500.0, outputs=True, pause_at_end=True)
    total = sum(info.message_count for info in BagReader(live.bag).topics.values())
    ros.spin_until(lambda: dict(player.health()[2])["messages_published"] == total)
    assert not player.finished()
    latched = [topic for topic in topics.RECORDED if topic.latched]
    late = ros.listen(*latched, name="late")
    ros.spin_until(lambda: all(late.count(topic) == 1 for topic in latched))
    for topic in latched:
        assert late.bytes(topic) == live.heard[topic.name][-1:], topic.name


def test_it_waits_for_nodes(ros: Ros, simulated: Path) -> None:
    """Nothing is sent before the node that is waited for is there; then nothing is lost to it."""
    player = ros.start(PlayerNode, bag=str(simulated), rate=500.0, wait_for_nodes="filter")
    ticks: list[int] = []
    ros.node("other").create_timer(0.05, lambda: ticks.append(1))
    ros.spin_until(lambda: len(ticks) >= 12)
    assert dict(player.health()[2])["messages_published"] == 0
    filtering = ros.start(FilterNode)
    ros.spin_until(lambda: dict(filtering.health()[2])["sets_processed"] == STEPS)
    assert not filtering.problems


def test_a_filter_on_the_time_of_the_bag(ros: Ros, live: LiveRun) -> None:
    """With use_sim_time the diagnostics of a filter carry the bag's time."""
    listener = ros.listen(topics.DIAGNOSTICS)
    filtering = ros.start(FilterNode, use_sim_time=True)
    player = ros.start(PlayerNode, bag=str(live.bag), rate=1.0, wait_for_nodes="filter")
    ros.spin_until(lambda: dict(filtering.health()[2])["sets_processed"] == STEPS)
    filtering.publish_diagnostics()
    ros.spin_until(
        lambda: any(m.status[0].name == "/filter" for m in listener.messages(topics.DIAGNOSTICS))
    )
    ours = [m for m in listener.messages(topics.DIAGNOSTICS) if m.status[0].name == "/filter"]
    reader = BagReader(live.bag)
    assert reader.start_time_ns is not None and reader.end_time_ns is not None
    stamp = ours[-1].header.stamp
    now = stamp.sec * SECOND + stamp.nanosec
    assert reader.start_time_ns <= now <= reader.end_time_ns + SECOND
    assert not player.problems


def test_the_rest_of_a_cut_bag_is_played(
    ros: Ros, cut_bag: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Of a bag that breaks off the beginning is played, and the log says what is missing."""
    player = ros.start(PlayerNode, bag=str(cut_bag), rate=500.0)
    ros.spin_until(player.finished)
    assert 0 < dict(player.health()[2])["messages_published"] < 3 * STEPS + 1
    log = capfd.readouterr().err
    assert "WARN" in log and "cut.mcap" in log and "dopslam recover" in log


def test_nothing_to_play(ros: Ros, tmp_path: Path) -> None:
    """A bag without topics that can be played is refused at the start."""
    with BagWriter(tmp_path / "bag") as writer:
        writer.add_topic("/diagnostics", topics.DIAGNOSTICS.type_name)
    with pytest.raises(StartError, match="none of the topics to play"):
        ros.start(PlayerNode, bag=str(tmp_path / "bag"))


def test_topics_of_others_are_played(ros: Ros, tmp_path: Path) -> None:
    """What ends like one of our outputs but belongs to somebody else is no output of ours."""
    names = ("/car/channel_measurements", "/car/odometry", "/wheel/odometry", "/strange")
    types = (topics.CHANNEL_MEASUREMENTS, topics.ODOMETRY, topics.ODOMETRY)
    with BagWriter(tmp_path / "bag") as writer:
        for name, topic in zip(names, types, strict=False):
            writer.add_topic(name, topic.type_name)
        writer.add_topic("/strange", "no_such_msgs/msg/Thing", definition="", type_hash="")
    player = ros.start(PlayerNode, bag=str(tmp_path / "bag"), pause_at_end=True)
    published = {name for name, _ in player.get_publisher_names_and_types_by_node("player", "/")}
    assert set(names) & published == {"/car/channel_measurements", "/wheel/odometry"}


def test_what_it_offers_is_what_was_offered(ros: Ros, live: LiveRun) -> None:
    """The topics come with the durability that they were recorded with."""
    from rclpy.qos import DurabilityPolicy

    ros.start(PlayerNode, bag=str(live.bag), outputs=True, wait_for_nodes="nobody")
    watcher = ros.node("watcher")
    for topic in (t for t in topics.RECORDED if t != topics.DIAGNOSTICS):
        name = "/" + topic.name
        ros.spin_until(lambda name=name: watcher.get_publishers_info_by_topic(name))
        (info,) = watcher.get_publishers_info_by_topic(name)
        latched = info.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
        assert latched == topic.latched, topic.name


def test_it_ends_as_a_process(processes: Processes, simulated: Path) -> None:
    """At the end of the bag the process exits with 0 and says how much it published."""
    process = processes.node("player", bag=simulated, rate=100.0)
    assert process.wait() == 0, process.stderr
    assert "end of the bag: 25 messages published" in process.stderr
    assert "Traceback" not in process.stderr
