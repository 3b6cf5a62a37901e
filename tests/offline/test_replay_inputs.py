"""Bags that are not as they should be: a clear error, or the right result for what can be read."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dopslam_ros.bag import (
    BagError,
    BagMessage,
    BagReader,
    BagWriter,
    message_class,
    serialize,
    type_hash,
)
from dopslam_ros.messages import topics
from dopslam_ros.messages.common import make_text
from dopslam_ros.offline.replay import replay
from dopslam_ros.offline.replay_inputs import ReplayError
from dopslam_ros.offline.replay_result import Replay
from dopslam_ros.simulation.recording import write_simulation
from dopslam_ros.simulation.scenario import load_scenario

STEPS = 4
SETTINGS = "/" + topics.FILTER_PARAMETERS.name


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bag of the first steps of the paper's scene, in many small chunks."""
    scenario = load_scenario("paper")
    path = tmp_path_factory.mktemp("simulated") / "bag"
    with BagWriter(path, chunk_bytes=1500, flush_seconds=None) as writer:
        write_simulation(replace(scenario, controls=scenario.controls[:STEPS]), 1, writer)
    return path


def changed(
    source: Path,
    target: Path,
    change: Callable[[BagMessage], BagMessage | None] = lambda message: message,
    added: tuple[BagMessage, ...] = (),
) -> BagReader:
    """A copy of a bag with each message as ``change`` makes it, or left out, and some more."""
    reader = BagReader(source)
    with BagWriter(target, flush_seconds=None) as writer:
        for message in (*map(change, reader.messages()), *added):
            if message is not None:
                writer.add_topic(message.topic, message.type_name)
                writer.write(message.topic, message.payload, message.log_time_ns)
    return BagReader(target)


def same(one: Replay, other: Replay) -> bool:
    """Whether two replays said the same."""
    return (
        [o.stamp_ns for o in one.outputs] == [o.stamp_ns for o in other.outputs]
        and all(
            np.array_equal(a.state.density.mean, b.state.density.mean)
            and np.array_equal(a.state.density.covariance, b.state.density.covariance)
            for a, b in zip(one.outputs, other.outputs, strict=True)
        )
        and one.parameters == other.parameters
        and one.problems == other.problems
        and {t: b.with_doppler.peb for t, b in one.bounds.items()}
        == {t: b.with_doppler.peb for t, b in other.bounds.items()}
    )


def test_a_thousand_corrupted_copies(simulated: Path, tmp_path: Path) -> None:
    """One to three flipped bits: what is read was in the bag, and whatever is missing is told.

    The replay of what can be read, of some of the copies, is that of a sound bag with just these
    messages.
    """
    data, rng = (simulated / "bag_0.mcap").read_bytes(), np.random.default_rng(11)
    whole = [tuple(message) for message in BagReader(simulated).messages()]
    expected, kinds, file = set(whole), [0, 0, 0], tmp_path / "flipped.mcap"
    for number in range(1000):
        flipped = bytearray(data)
        for position in rng.integers(len(data), size=int(rng.integers(1, 4))):
            flipped[position] ^= 1 << int(rng.integers(8))
        file.write_bytes(flipped)
        try:
            reader = BagReader(file)
            found = list(reader.messages())
        except BagError as error:
            assert str(file) in str(error)
            kinds[0] += 1
            continue
        assert len(set(found)) == len(found) and {tuple(m) for m in found} <= expected
        complete = len(found) == len(whole)
        assert complete or reader.damage is not None
        kinds[1 + complete] += 1
        if not complete and number % 40 == 0:
            _check_partial(file, found, tmp_path / f"sound{number}")
    assert min(kinds[1:]) > 50  # both happen; a refusal needs a flip among the first bytes


def _check_partial(file: Path, found: list[BagMessage], sound: Path) -> None:
    try:
        run = replay(BagReader(file))
    except ReplayError as error:  # the settings or all measurements are lost, and it says so
        text = str(error)
        assert "damaged part" in text or "no topic" in text
        return
    assert run.damage is not None
    with BagWriter(sound, flush_seconds=None) as writer:
        for message in found:
            writer.add_topic(message.topic, message.type_name)
            writer.write(message.topic, message.payload, message.log_time_ns)
    # Where the index promised a truth that is lost, the bounds are too.
    again = replay(BagReader(sound))
    if {"/truth/ue", "/truth/landmarks"} <= {message.topic for message in found}:
        assert same(run, again)
    else:
        assert same(replace(run, bounds={}), replace(again, bounds={}))


@pytest.mark.parametrize("part", np.linspace(0.05, 0.98, 12).round(2).tolist())
def test_a_bag_that_is_cut_off(simulated: Path, tmp_path: Path, part: float) -> None:
    """Wherever it is cut: the beginning of the run, as from the whole bag, or a clear error."""
    data, file = (simulated / "bag_0.mcap").read_bytes(), tmp_path / "cut.mcap"
    file.write_bytes(data[: int(part * len(data))])
    complete = replay(BagReader(simulated))
    try:
        run = replay(BagReader(file))
    except ReplayError as error:
        assert "has no topic" in str(error) and "dopslam recover" in str(error)
        assert part < 0.4
        return
    assert run.damage is not None and "dopslam recover" in run.damage
    # The last step may lack its control; those before are the same.
    for ours, theirs in zip(run.outputs[:-1], complete.outputs, strict=False):
        assert np.array_equal(ours.state.density.mean, theirs.state.density.mean)


def test_an_empty_bag(tmp_path: Path) -> None:
    """No topics: that is said. Topics without messages: no steps, no numbers."""
    with BagWriter(tmp_path / "nothing"):
        pass
    with pytest.raises(ReplayError, match=r"has no topic .*; its topics: none"):
        replay(BagReader(tmp_path / "nothing"))
    with BagWriter(tmp_path / "silent") as writer:
        for topic in topics.INPUTS:
            writer.add_topic("/" + topic.name, topic.type_name)
    run = replay(BagReader(tmp_path / "silent"))
    assert not run.outputs and not run.bounds and not run.records()


@pytest.mark.parametrize("topic", [*topics.INPUTS, topics.FILTER_PARAMETERS], ids=lambda t: t.name)
def test_a_topic_of_another_type(simulated: Path, tmp_path: Path, topic: topics.Topic) -> None:
    """The bytes of another type are never taken for numbers: its name is the error."""
    name = "/" + topic.name

    def other(message: BagMessage) -> BagMessage:
        if message.topic != name:
            return message
        return message._replace(type_name="geometry_msgs/msg/AccelStamped")

    reader = changed(simulated, tmp_path / "bag", other)
    with pytest.raises(ReplayError, match=f"{name} of .* has type geometry_msgs/msg/AccelStamped"):
        replay(reader)


def test_another_definition_of_a_type(tmp_path: Path) -> None:
    """The type's name is right, its fields were others: no guess at what the bytes mean."""
    name, kind = "/channel_measurements", topics.CHANNEL_MEASUREMENTS.type_name
    wrong = type_hash(kind)[:-1] + "x"
    with BagWriter(tmp_path / "bag") as writer:
        writer.add_topic(name, kind, type_hash=wrong)
    with pytest.raises(ReplayError, match="another definition of dopslam_msgs"):
        replay(BagReader(tmp_path / "bag"))


@pytest.mark.parametrize("missing", [*topics.INPUTS, topics.FILTER_PARAMETERS], ids=str)
def test_a_topic_that_is_missing(simulated: Path, tmp_path: Path, missing: topics.Topic) -> None:
    """Without sets there is nothing to do; without another topic there is what can be had."""
    name = "/" + missing.name
    reader = changed(simulated, tmp_path / "bag", lambda m: None if m.topic == name else m)
    if missing == topics.CHANNEL_MEASUREMENTS:
        with pytest.raises(ReplayError, match=r"has no topic .*channel_measurements"):
            replay(reader)
        return
    run = replay(reader)
    assert len(run.outputs) == len(run.bounds) == STEPS
    assert all(np.isfinite(o.state.density.mean).all() for o in run.outputs)
    assert bool(run.problems) == (missing == topics.ODOMETRY_CONTROL)


def test_topics_of_others_change_nothing(simulated: Path, tmp_path: Path) -> None:
    """Another vehicle's outputs and somebody's chatter are left alone."""
    outputs = tmp_path / "outputs"
    with BagWriter(outputs, flush_seconds=None) as writer:
        replay(BagReader(simulated), writer=writer)
    inputs = {"/" + topic.name for topic in topics.INPUTS}
    others = tuple(
        message._replace(topic="/other" + message.topic)
        for message in BagReader(outputs).messages()
        if message.topic not in inputs
    )
    reader = changed(simulated, tmp_path / "bag", added=others)
    assert same(replay(reader), replay(BagReader(simulated)))


def test_two_filters_in_a_bag(simulated: Path, tmp_path: Path) -> None:
    """The settings of two filters: no matter where they agree, asked for where they differ."""
    first = next(BagReader(simulated).messages({SETTINGS}))

    def settings(text: str) -> BagMessage:
        payload = serialize(make_text(message_class, text), first.type_name)
        return first._replace(payload=payload)

    agreeing = changed(simulated, tmp_path / "agree", added=(first,))
    assert same(replay(agreeing), replay(BagReader(simulated)))
    text = first.payload[8:].rstrip(b"\0").decode()
    assert "gamma: 10" in text
    other = settings(text.replace("gamma: 10", "gamma: 3"))
    differing = changed(simulated, tmp_path / "differ", added=(other,))
    with pytest.raises(ReplayError, match="2 filters, which differ: gamma is 10 or 3; say which"):
        replay(differing)
    assert replay(differing, {"gamma": 3}).parameters.gamma == 3


def test_settings_that_are_lost(simulated: Path, tmp_path: Path) -> None:
    """A run is not quietly filtered with other settings than those it was recorded with."""
    file, reader = tmp_path / "spoiled.mcap", BagReader(simulated)
    data = bytearray((simulated / "bag_0.mcap").read_bytes())
    block = reader._files[0].blocks[0]
    data[block.offset + block.length // 2] ^= 1
    file.write_bytes(data)
    with pytest.raises(ReplayError, match=r"filter_parameters, are in the damaged part .*--params"):
        replay(BagReader(file))
    assert replay(BagReader(file), {"gamma": 3}).parameters.gamma == 3
