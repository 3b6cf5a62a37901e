"""Live and offline: the same inputs give the same bytes, whatever the order they come in."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from dopslam_ros.bag import BagMessage, BagReader, BagWriter
from dopslam_ros.core.pmb import FilterParameters
from dopslam_ros.core.settings.parameters import ParameterError
from dopslam_ros.messages import topics
from dopslam_ros.nodes.filter import FilterNode
from dopslam_ros.nodes.player import PlayerNode
from dopslam_ros.offline.replay import replay
from dopslam_ros.offline.replay_inputs import ReplayError
from dopslam_ros.offline.replay_result import Replay

if TYPE_CHECKING:
    from tests.conftest import LiveRun, Ros

STEPS = 8
Payloads = Callable[..., list[bytes]]
NEEDED = {"/" + topic.name for topic in topics.INPUTS}
RESULTS = tuple(t for t in topics.OUTPUTS if t != topics.FILTER_PARAMETERS)


def replayed(bag: Path, out: Path, **overrides: object) -> Replay:
    """Replays a bag into another one."""
    with BagWriter(out, flush_seconds=None) as writer:
        return replay(BagReader(bag), overrides, writer)


def copied(bag: Path, out: Path, order: Callable[[list[BagMessage]], Sequence[BagMessage]]) -> Path:
    """A bag with the messages of another one in another order of reception."""
    reader = BagReader(bag)
    with BagWriter(out, flush_seconds=None) as writer:
        for name, info in reader.topics.items():
            writer.add_topic(name, info.type_name, qos=info.qos)
        for number, message in enumerate(order(list(reader.messages()))):
            writer.write(message.topic, message.payload, 10**9 + number)
    return out


@pytest.mark.parametrize("topic", RESULTS, ids=lambda topic: topic.name)
def test_replay_equals_the_live_run(
    live: LiveRun, tmp_path: Path, bag_payloads: Payloads, topic: topics.Topic
) -> None:
    """What the filter and the bounds said live, the replay says again: each byte of each topic."""
    run = replayed(live.bag, tmp_path / "again")
    again = bag_payloads(tmp_path / "again", topic)
    assert len(again) == STEPS
    assert again == live.heard[topic.name]
    assert not run.problems and run.damage is None


def test_replay_keeps_the_inputs(live: LiveRun, tmp_path: Path, bag_payloads: Payloads) -> None:
    """The new bag has the inputs as they were, so that it stands for itself."""
    replayed(live.bag, tmp_path / "again")
    for topic in topics.INPUTS:
        assert bag_payloads(tmp_path / "again", topic) == live.heard[topic.name]


def test_replay_of_a_replay(live: LiveRun, tmp_path: Path) -> None:
    """The replay of a replay is the same file, byte for byte."""
    replayed(live.bag, tmp_path / "first" / "bag")
    replayed(tmp_path / "first" / "bag", tmp_path / "second" / "bag")
    first, second = (tmp_path / name / "bag" / "bag_0.mcap" for name in ("first", "second"))
    assert first.read_bytes() == second.read_bytes()


@pytest.mark.parametrize("seed", range(4))
def test_interleaving_does_not_matter(
    live: LiveRun, tmp_path: Path, bag_payloads: Payloads, seed: int
) -> None:
    """However topics overtake each other, within the wait for a control, results are the same."""
    rng = np.random.default_rng(seed)
    periods = list(range(STEPS))

    def interleave(messages: list[BagMessage]) -> list[BagMessage]:
        arrivals = []
        for name in sorted({m.topic for m in messages}):
            queue = [m for m in messages if m.topic == name]
            # A control is waited for until a set has come that is control_wait, two periods, newer.
            late = np.maximum.accumulate(periods + rng.uniform(0.0, 1.95, STEPS))
            arrivals += list(zip(np.resize(late, len(queue)), queue, strict=True))
        return [message for _, message in sorted(arrivals, key=lambda pair: pair[0])]

    copied(live.bag, tmp_path / "mixed", interleave)
    inputs = [m.payload for m in BagReader(tmp_path / "mixed").messages(NEEDED)]
    assert inputs != [m.payload for m in BagReader(live.bag).messages(NEEDED)]
    run = replayed(tmp_path / "mixed", tmp_path / "again")
    assert not run.problems
    for topic in (topics.UE_STATE, topics.LANDMARKS, topics.BOUNDS):
        assert bag_payloads(tmp_path / "again", topic) == live.heard[topic.name], topic.name


def play_into_filter(ros: Ros, bag: Path) -> dict[str, list[bytes]]:
    """What a filter node says to a bag that is played to it."""
    listener = ros.listen(*RESULTS)
    every = {"path_period": 0.0, "path_spacing": 0.0, "markers_period": 0.0}
    filtering = ros.start(FilterNode, map_frame="world", base_frame="m", **every)
    ros.spin_until(lambda: filtering.count_subscribers("ue_state") == 1)
    player = ros.start(PlayerNode, bag=str(bag), rate=100.0, wait_for_nodes="filter")
    ros.spin_until(player.finished)
    ros.spin_until(lambda: listener.count(topics.LANDMARK_MARKERS) == STEPS)
    assert not filtering.problems
    heard = {name: [bytes(p) for p in found] for name, found in listener.payloads.items()}
    for node in (player, filtering, listener.node):
        ros.remove(node)
    return heard


def test_two_live_runs_of_one_bag_are_equal(ros: Ros, live: LiveRun) -> None:
    """A bag played twice, each time to a fresh filter, gives the recorded bytes both times."""
    first, second = (play_into_filter(ros, live.bag) for _ in range(2))
    assert first == second
    for topic in RESULTS:
        if topic != topics.BOUNDS:
            assert first[topic.name] == live.heard[topic.name], topic.name


def test_settings_come_from_the_bag(live: LiveRun, tmp_path: Path, bag_payloads: Payloads) -> None:
    """A replay is set as the live filter was; what is overridden changes, and the bag says so."""
    assert replay(BagReader(live.bag)).parameters == FilterParameters()
    run = replayed(live.bag, tmp_path / "other", gamma=1, coupling="marginal")
    assert (run.parameters.gamma, run.parameters.coupling) == (1, "marginal")
    assert bag_payloads(tmp_path / "other", topics.UE_STATE) != live.heard[topics.UE_STATE.name]
    again = replayed(tmp_path / "other", tmp_path / "again")
    assert again.parameters == run.parameters
    ours = bag_payloads(tmp_path / "again", topics.UE_STATE)
    assert ours == bag_payloads(tmp_path / "other", topics.UE_STATE)


def test_wrong_settings_are_refused(live: LiveRun) -> None:
    """An override that cannot be used stops the replay with a reason."""
    with pytest.raises(ParameterError, match=r"gamma.*1 \.\. 1000"):
        replay(BagReader(live.bag), {"gamma": 0})
    with pytest.raises(ParameterError, match="did you mean 'gamma'"):
        replay(BagReader(live.bag), {"gama": 3})


def test_bag_without_the_topics(tmp_path: Path) -> None:
    """A bag of somebody else: the message says what is missing and what is there."""
    with BagWriter(tmp_path / "bag") as writer:
        writer.add_topic("/chatter", "std_msgs/msg/String")
    with pytest.raises(ReplayError, match=r"no topic .*channel_measurements; .*/chatter"):
        replay(BagReader(tmp_path / "bag"))


def test_topic_of_another_type(tmp_path: Path) -> None:
    """A topic with the right name and another type is refused by its type."""
    with BagWriter(tmp_path / "bag") as writer:
        writer.add_topic("/channel_measurements", "std_msgs/msg/String")
    with pytest.raises(ReplayError, match="has type std_msgs/msg/String, not dopslam_msgs"):
        replay(BagReader(tmp_path / "bag"))


def test_a_namespace_is_kept(live: LiveRun, tmp_path: Path, bag_payloads: Payloads) -> None:
    """A bag recorded in a namespace is replayed in it, with the same results."""
    reader = BagReader(live.bag)
    with BagWriter(tmp_path / "car7", flush_seconds=None) as writer:
        for message in reader.messages():
            writer.add_topic("/car7" + message.topic, message.type_name)
            writer.write("/car7" + message.topic, message.payload, message.log_time_ns)
    replayed(tmp_path / "car7", tmp_path / "again")
    ours = bag_payloads(tmp_path / "again", topics.UE_STATE, "/car7/")
    assert ours == live.heard[topics.UE_STATE.name]


def test_two_vehicles_in_a_bag(live: LiveRun, tmp_path: Path) -> None:
    """Of a bag with two vehicles it is not guessed which one is meant."""
    with BagWriter(tmp_path / "bag") as writer:
        for name in ("/car7", "/car8"):
            writer.add_topic(f"{name}/channel_measurements", topics.CHANNEL_MEASUREMENTS.type_name)
    with pytest.raises(ReplayError, match="several vehicles"):
        replay(BagReader(tmp_path / "bag"))


def test_garbage_in_a_bag_is_counted(live: LiveRun, tmp_path: Path, bag_payloads: Payloads) -> None:
    """Bytes that are no message, as a recorder may have met them, do not end a replay."""

    def with_garbage(messages: list[BagMessage]) -> list[BagMessage]:
        spoiled = []
        for message in messages:
            spoiled += [message, message._replace(payload=message.payload[:11])]
        return spoiled

    count = sum(BagReader(live.bag).topics[name].message_count for name in NEEDED)

    def spoil(messages: list[BagMessage]) -> list[BagMessage]:
        rest = [m for m in messages if m.topic not in NEEDED]
        return rest + with_garbage([m for m in messages if m.topic in NEEDED])

    copied(live.bag, tmp_path / "spoiled", spoil)
    run = replayed(tmp_path / "spoiled", tmp_path / "again")
    assert run.problems == {"malformed_message": count}
    assert bag_payloads(tmp_path / "again", topics.UE_STATE) == live.heard[topics.UE_STATE.name]


def test_no_truth_no_errors(live: LiveRun, tmp_path: Path) -> None:
    """Without truth in the bag the estimates are the same and nothing is judged."""
    names = {"/channel_measurements", "/odometry_control"}
    copied(live.bag, tmp_path / "bag", lambda all_: [m for m in all_ if m.topic in names])
    run = replay(BagReader(tmp_path / "bag"))
    assert len(run.outputs) == len(run.bounds) == STEPS  # these at the estimates
    assert all(np.isnan(record.error).all() for record in run.records())
    judged = replay(BagReader(live.bag))
    assert all(
        np.array_equal(a.state.density.mean, b.state.density.mean)
        for a, b in zip(run.outputs, judged.outputs, strict=True)
    )
    assert all(np.isfinite(record.error).all() for record in judged.records())
