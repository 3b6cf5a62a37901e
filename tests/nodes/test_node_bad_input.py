"""Bad input at the filter node: refused or handled, counted, and without a trace in the results."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from dopslam_ros.bag import BagReader, BagWriter, deserialize, message_class, serialize
from dopslam_ros.core.models.measurements import MOST_PATHS
from dopslam_ros.core.models.motion import Control
from dopslam_ros.messages import topics
from dopslam_ros.messages.common import Frames
from dopslam_ros.messages.inputs import make_control
from dopslam_ros.nodes.bounds import BoundsNode
from dopslam_ros.nodes.filter import FilterNode
from dopslam_ros.nodes.middleware import Output, middleware_class, qos_profile
from dopslam_ros.nodes.node import DopslamNode
from dopslam_ros.offline.replay import replay

if TYPE_CHECKING:
    from tests.conftest import Listener, Ros

SETS, CONTROLS = topics.CHANNEL_MEASUREMENTS, topics.ODOMETRY_CONTROL
# The set that gets bad company.
PLACE = 3
SECOND = 1_000_000_000


@dataclass
class Bench:
    """A filter node that is fed by hand.

    Attributes:
        ros: where it runs.
        node: the filter.
        heard: what it says.
        sets: the good sets, in order.
        controls: the controls that belong to them.
    """

    ros: Ros
    node: Any
    heard: Listener
    sets: list[bytes]
    controls: list[bytes]
    outputs: dict[topics.Topic, Any]

    def send(self, topic: topics.Topic, payload: bytes) -> None:
        """Publishes bytes, whatever they are."""
        self.outputs[topic].publish(payload)

    def send_step(self, step: int) -> None:
        """A good set, its control, and waits for the state."""
        count = self.heard.count(topics.UE_STATE) + 1
        self.send(SETS, self.sets[step])
        self.send(CONTROLS, self.controls[step])
        self.wait_for_states(count)

    def wait_for_states(self, count: int) -> None:
        """Waits until so many states and maps were published."""
        for topic in (topics.UE_STATE, topics.LANDMARKS):
            self.ros.spin_until(lambda topic=topic: self.heard.count(topic) == count)

    def expect(self, reason: str, count: int = 1) -> None:
        """Waits for a problem to be counted, and sees it on /diagnostics."""
        self.ros.spin_until(lambda: self.counted().get(reason) == count)
        assert self.counted() == {reason: count}

    def counted(self) -> dict[str, int]:
        """The problems, as the newest status on /diagnostics tells them."""
        before = self.heard.count(topics.DIAGNOSTICS)
        self.node.publish_diagnostics()
        self.ros.spin_until(lambda: self.heard.count(topics.DIAGNOSTICS) > before)
        (status,) = self.heard.messages(topics.DIAGNOSTICS)[-1].status
        values = {v.key: v.value for v in status.values}
        found = {k.removeprefix("problem."): int(v) for k, v in values.items() if "problem." in k}
        assert status.level == (1 if found else 0)
        return found


def make_bench(ros: Ros, bag: Path) -> Bench:
    """A filter, somebody who feeds it, and somebody who listens."""
    heard = ros.listen(topics.UE_STATE, topics.LANDMARKS, topics.DIAGNOSTICS)
    node = ros.start(FilterNode)
    feeder = ros.node("feeder")
    publishers = {
        t: feeder.create_publisher(middleware_class(t.type_name), t.name, qos_profile(t.qos))
        for t in (SETS, CONTROLS)
    }
    ros.spin_until(lambda: all(p.get_subscription_count() == 1 for p in publishers.values()))
    ros.spin_until(lambda: node.count_subscribers("ue_state") == 1)
    sets, controls = (
        [m.payload for m in BagReader(bag).messages({"/" + t.name})] for t in (SETS, CONTROLS)
    )
    return Bench(ros, node, heard, sets, controls, publishers)


@pytest.fixture
def bench(ros: Ros, simulated: Path) -> Bench:
    """A filter node that is fed by hand."""
    return make_bench(ros, simulated)


@pytest.fixture(scope="module")
def clean(session_ros: Ros, simulated: Path) -> tuple[list[bytes], list[bytes]]:
    """States and maps of a run without anything bad."""
    bench = make_bench(session_ros, simulated)
    for step in range(len(bench.sets)):
        bench.send_step(step)
    assert bench.counted() == {}
    return bench.heard.bytes(topics.UE_STATE), bench.heard.bytes(topics.LANDMARKS)


def changed(payload: bytes, topic: topics.Topic, change: Callable[[Any], object]) -> bytes:
    """A message with something done to it."""
    message = deserialize(payload, topic.type_name)
    change(message)
    return serialize(message, topic.type_name)


def covariance(change: Callable[[np.ndarray], object]) -> Callable[[Any], None]:
    """Gives the first path a covariance of its own, spoiled by ``change``."""

    def spoil(message: Any) -> None:
        matrix = np.diag([0.01, 0.0025, 0.0025, 0.0025, 0.0025, 0.01])
        change(matrix)
        message.paths[0].covariance = matrix.reshape(-1)

    return spoil


def put(row: int, column: int, value: float) -> Callable[[np.ndarray], None]:
    """Sets one number of a matrix."""

    def apply(matrix: np.ndarray) -> None:
        matrix[row, column] = value

    return apply


def first_path(**values: float) -> Callable[[Any], None]:
    """Sets components of the first path."""

    def spoil(message: Any) -> None:
        for name, value in values.items():
            setattr(message.paths[0], name, value)

    return spoil


def all_nan(message: Any) -> None:
    """Leaves nothing of the last path."""
    for name in ("path_length", "aoa_azimuth", "aoa_elevation", "aod_azimuth", "aod_elevation"):
        setattr(message.paths[-1], name, np.nan)
    message.paths[-1].doppler = np.nan


def stamped(sec: int, nanosec: int) -> Callable[[Any], None]:
    """Sets the stamp."""

    def spoil(message: Any) -> None:
        message.header.stamp.sec, message.header.stamp.nanosec = sec, nanosec

    return spoil


def too_many(message: Any) -> None:
    """One path more than is taken."""
    message.paths = [message.paths[0]] * (MOST_PATHS + 1)


def far_too_many(message: Any) -> None:
    """So many that the message is not even read."""
    message.paths = [message.paths[0]] * 10_000


BAD_SETS: dict[str, tuple[Callable[[Any], None], str]] = {
    "infinite path length": (first_path(path_length=np.inf), "implausible_value"),
    "infinite Doppler": (first_path(doppler=-np.inf), "implausible_value"),
    "azimuth in degrees": (first_path(aoa_azimuth=90.0), "implausible_value"),
    "path of NaN": (all_nan, "nothing_measured"),
    "NaN in the covariance": (covariance(put(1, 1, np.nan)), "covariance_not_finite"),
    "infinite covariance": (covariance(put(0, 0, np.inf)), "covariance_not_finite"),
    "negative variance": (covariance(put(2, 2, -0.1)), "covariance_not_positive_definite"),
    "zero variance": (covariance(put(2, 2, 0.0)), "covariance_not_positive_definite"),
    "one-sided covariance": (covariance(put(0, 1, 0.001)), "covariance_not_symmetric"),
    "no stamp": (stamped(0, 0), "no_stamp"),
    "negative stamp": (stamped(-5, 0), "invalid_stamp"),
    "overflowing stamp": (stamped(3, SECOND), "invalid_stamp"),
    "a path too many": (too_many, "too_many_paths"),
    "10,000 paths": (far_too_many, "message_too_large"),
    "time runs backward": (stamped(1, 250_000_000), "late"),
}


@pytest.mark.parametrize(("change", "reason"), BAD_SETS.values(), ids=BAD_SETS.keys())
def test_a_bad_set_leaves_no_trace(
    bench: Bench,
    clean: tuple[list[bytes], list[bytes]],
    change: Callable[[Any], None],
    reason: str,
) -> None:
    """It is refused and counted under its reason; all else is as if it had never come."""
    for step in range(len(bench.sets)):
        if step == PLACE:
            bench.send(SETS, changed(bench.sets[PLACE], SETS, change))
            bench.expect(reason)
        bench.send_step(step)
    assert bench.heard.bytes(topics.UE_STATE) == clean[0]
    assert bench.heard.bytes(topics.LANDMARKS) == clean[1]
    assert bench.counted() == {reason: 1}


def test_a_covariance_that_is_nearly_singular(bench: Bench) -> None:
    """Two components that are fully correlated are refused, in whatever units."""

    def correlate(matrix: np.ndarray) -> None:
        matrix[0, 1] = matrix[1, 0] = np.sqrt(matrix[0, 0] * matrix[1, 1])

    bench.send(SETS, changed(bench.sets[0], SETS, covariance(correlate)))
    bench.expect("covariance_not_positive_definite")


def test_nan_where_nothing_was_measured(bench: Bench) -> None:
    """NaN in a component, and in the covariance that belongs to it, is allowed."""

    def partial(message: Any) -> None:
        for path in message.paths:
            path.doppler = path.aod_elevation = np.nan
            matrix = np.diag([0.01, 0.0025, 0.0025, 0.0025, np.nan, np.nan])
            path.covariance = matrix.reshape(-1)

    bench.send(SETS, changed(bench.sets[0], SETS, partial))
    bench.send(CONTROLS, bench.controls[0])
    bench.ros.spin_until(lambda: bench.heard.count(topics.UE_STATE) == 1)
    assert bench.counted() == {}


def test_a_second_set_with_the_same_stamp(
    bench: Bench, clean: tuple[list[bytes], list[bytes]]
) -> None:
    """Of two sets with one stamp the first counts, whether it still waits or is processed."""
    for step in range(len(bench.sets)):
        if step == PLACE:
            bench.send(SETS, bench.sets[step])
            bench.ros.spin_until(lambda: bench.node.health()[2][1] == ("sets_waiting", 1))
            bench.send(SETS, bench.sets[step])
            bench.expect("duplicate_stamp")
            bench.send(CONTROLS, bench.controls[step])
            bench.wait_for_states(PLACE + 1)
            bench.send(SETS, bench.sets[step])
            bench.expect("duplicate_stamp", 2)
        else:
            bench.send_step(step)
    assert bench.heard.bytes(topics.UE_STATE) == clean[0]


def control(stamp_ns: int, speed: float, turn_rate: float) -> bytes:
    """A control."""
    message = make_control(message_class, stamp_ns, Control(speed, turn_rate), Frames())
    return serialize(message, CONTROLS.type_name)


# Between the controls at 2.0 s and at 2.5 s.
BAD_CONTROLS = {
    "NaN speed": (control(2_250_000_000, np.nan, 0.0), "invalid_control"),
    "NaN turn rate": (control(2_250_000_000, 1.0, np.nan), "invalid_control"),
    "infinite speed": (control(2_250_000_000, np.inf, 0.0), "invalid_control"),
    "impossible speed": (control(2_250_000_000, 1e9, 0.0), "invalid_control"),
    "impossible turn rate": (control(2_250_000_000, 1.0, -1e4), "invalid_control"),
    "backward": (control(1_250_000_000, 99.0, 1.0), "late_control"),
    "same time": (control(2_000_000_000, 99.0, 1.0), "duplicate_stamp"),
    "no stamp": (control(0, 99.0, 1.0), "no_stamp"),
    "garbage": (b"\0\1\0\0\7", "malformed_message"),
}


@pytest.mark.parametrize(("payload", "reason"), BAD_CONTROLS.values(), ids=BAD_CONTROLS.keys())
def test_a_bad_control_leaves_no_trace(
    bench: Bench, clean: tuple[list[bytes], list[bytes]], payload: bytes, reason: str
) -> None:
    """It is refused and counted under its reason; all else is as if it had never come."""
    for step in range(len(bench.sets)):
        if step == PLACE:
            bench.send(CONTROLS, payload)
            bench.expect(reason)
        bench.send_step(step)
    assert bench.heard.bytes(topics.UE_STATE) == clean[0]


def at(payload: bytes, offset: int, new: bytes) -> bytes:
    """Bytes with some of them replaced."""
    return payload[:offset] + new + payload[offset + len(new) :]


def malformed(good: bytes) -> Iterable[bytes]:
    """Bytes that are no measurement set."""
    rng = np.random.default_rng(3)
    count = 4 + 8 + 4 + 12  # after the CDR header, the stamp and "base_link" with its length
    yield b""
    yield good[:3]
    yield good[:4]
    yield good[:50]
    yield good[:-8]
    yield rng.bytes(500)
    yield b"\0\1\0\0" + rng.bytes(500)
    yield at(good, 12, struct.pack("<I", 0xFFFFFFFF))  # the length of the frame's name
    yield at(good, 16, b"\xff\xfe")  # the name is no UTF-8
    yield at(good, count, struct.pack("<I", 0xFFFFFFF0))  # the number of paths
    yield at(good, 0, b"\0\0\0\0")  # says it is big-endian
    yield at(good, 0, b"\7\7\7\7")


def test_bytes_that_are_no_message(bench: Bench, clean: tuple[list[bytes], list[bytes]]) -> None:
    """Garbage on the topic: each piece is counted, the node lives and the results are clean."""
    rubbish = list(malformed(bench.sets[PLACE]))
    for step in range(len(bench.sets)):
        if step == PLACE:
            for payload in rubbish:
                bench.send(SETS, payload)
            bench.expect("malformed_message", len(rubbish))
        bench.send_step(step)
    assert bench.heard.bytes(topics.UE_STATE) == clean[0]


def test_an_empty_set_is_a_snapshot(bench: Bench, clean: tuple[list[bytes], list[bytes]]) -> None:
    """Nothing detected is information: the state moves on, grows less certain, nothing is wrong."""

    def empty(message: Any) -> None:
        message.paths = []

    bench.sets[PLACE] = changed(bench.sets[PLACE], SETS, empty)
    for step in range(len(bench.sets)):
        bench.send_step(step)
    ours = bench.heard.bytes(topics.UE_STATE)
    assert ours[:PLACE] == clean[0][:PLACE]
    assert all(a != b for a, b in zip(ours[PLACE:], clean[0][PLACE:], strict=True))
    states = bench.heard.messages(topics.UE_STATE)
    before, after = (np.reshape(states[n].covariance, (4, 4)) for n in (PLACE - 1, PLACE))
    assert np.all(np.diag(after)[[0, 1, 3]] > np.diag(before)[[0, 1, 3]])
    assert all(reason == "empty_set" for reason in bench.counted())


def test_a_control_that_never_comes(bench: Bench, clean: tuple[list[bytes], list[bytes]]) -> None:
    """Sets whose control is missing wait for a bounded time, then are processed and counted."""
    for step in range(PLACE):
        bench.send_step(step)
    for payload in bench.sets[PLACE:]:
        bench.send(SETS, payload)
    missing = len(bench.sets) - PLACE
    # Those that newer ones are ahead of by control_wait do not wait for the clock.
    bench.ros.spin_until(lambda: bench.heard.count(topics.UE_STATE) == len(bench.sets) - 2, 0.9)
    bench.ros.spin_until(lambda: bench.heard.count(topics.UE_STATE) == len(bench.sets), 4.0)
    assert bench.counted() == {"missing_control": missing}
    ours = bench.heard.bytes(topics.UE_STATE)
    assert ours[:PLACE] == clean[0][:PLACE]
    bench.send(CONTROLS, control(50 * SECOND, 1.0, 0.0))
    bench.send(SETS, changed(bench.sets[0], SETS, stamped(50, 0)))
    bench.ros.spin_until(lambda: bench.heard.count(topics.UE_STATE) == len(bench.sets) + 1)


def test_no_control_at_all(bench: Bench) -> None:
    """Without any odometry the sets are still processed, in order, and the lack is counted."""
    for payload in bench.sets:
        bench.send(SETS, payload)
    bench.ros.spin_until(lambda: bench.heard.count(topics.UE_STATE) == len(bench.sets))
    assert bench.counted() == {"missing_control": len(bench.sets)}
    stamps = [
        m.header.stamp.sec * SECOND + m.header.stamp.nanosec
        for m in bench.heard.messages(topics.UE_STATE)
    ]
    assert stamps == sorted(set(stamps))


def test_a_set_that_was_overtaken(bench: Bench, simulated: Path, tmp_path: Path) -> None:
    """A set that comes after a newer one is refused; all else is as if it had never been."""
    for step in range(len(bench.sets)):
        if step == PLACE:
            continue
        if step == PLACE + 1:
            bench.send(CONTROLS, bench.controls[PLACE])
            bench.send(SETS, bench.sets[step])
            bench.ros.spin_until(lambda: bench.node.health()[2][1] == ("sets_waiting", 1))
            bench.send(SETS, bench.sets[PLACE])
            bench.expect("late")
            bench.send(CONTROLS, bench.controls[step])
            bench.wait_for_states(step)
        else:
            bench.send_step(step)
    with BagWriter(tmp_path / "bag") as writer:
        for message in BagReader(simulated).messages():
            writer.add_topic(message.topic, message.type_name)
            if message.payload != bench.sets[PLACE]:
                writer.write(message.topic, message.payload, message.log_time_ns)
    with BagWriter(tmp_path / "again") as writer:
        replay(BagReader(tmp_path / "bag"), None, writer)
    expected = [m.payload for m in BagReader(tmp_path / "again").messages({"/ue_state"})]
    assert len(expected) == len(bench.sets) - 1
    assert bench.heard.bytes(topics.UE_STATE) == expected


def test_a_run_of_trouble_is_logged_sparingly(
    bench: Bench, capfd: pytest.CaptureFixture[str]
) -> None:
    """The log names the reason and the remedy, once and not a thousand times; all are counted."""
    bad = changed(bench.sets[0], SETS, stamped(0, 0))
    for _ in range(90):  # no more than may wait
        bench.send(SETS, bad)
    bench.expect("no_stamp", 90)
    lines = [line for line in capfd.readouterr().err.splitlines() if "WARN" in line]
    assert len(lines) == 1
    assert "channel_measurements: refused (no_stamp" in lines[0] and "fill in" in lines[0]


def test_bad_truth_at_the_bounds(ros: Ros, simulated: Path) -> None:
    """The bounds refuse garbage, NaN states and unknown landmark types, count them and go on."""
    node: DopslamNode = ros.start(BoundsNode, source="truth")
    heard = ros.listen(topics.BOUNDS)
    feeder = ros.node("feeder")
    wanted = (topics.TRUTH_LANDMARKS, topics.TRUTH_UE, CONTROLS)
    outputs = {
        "/" + t.name: Output(
            feeder.create_publisher(middleware_class(t.type_name), t.name, qos_profile(t.qos)),
            t.type_name,
        ).publisher
        for t in wanted
    }
    ros.spin_until(lambda: all(p.get_subscription_count() == 1 for p in outputs.values()))
    ros.spin_until(lambda: node.count_subscribers("bounds") == 1)
    good = {name: [m.payload for m in BagReader(simulated).messages({name})] for name in outputs}

    def spoil_state(message: Any) -> None:
        message.clock_bias = np.nan

    def spoil_type(message: Any) -> None:
        message.landmarks[1].type = 9

    def spoil_position(message: Any) -> None:
        message.landmarks[1].position.x = np.inf

    states, maps = "/truth/ue", "/truth/landmarks"
    outputs[states].publish(b"rubbish")
    outputs[states].publish(changed(good[states][0], topics.TRUTH_UE, spoil_state))
    outputs[maps].publish(changed(good[maps][0], topics.TRUTH_LANDMARKS, spoil_type))
    outputs[maps].publish(changed(good[maps][0], topics.TRUTH_LANDMARKS, spoil_position))
    expected = {"malformed_message", "state_not_finite", "unknown_type", "position_not_finite"}
    ros.spin_until(lambda: node.problems.keys() == expected)
    for name in (maps, states, "/odometry_control"):
        for payload in good[name]:
            outputs[name].publish(payload)
    ros.spin_until(lambda: heard.count(topics.BOUNDS) == 8)
    assert set(node.problems.values()) == {1}
