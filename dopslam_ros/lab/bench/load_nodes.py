"""Who sends much: to the recorder all that it must keep, to the filter too much.

``python -m dopslam_ros.lab.bench.load_nodes feed|overload`` with arguments of their own.
"""

from __future__ import annotations

import json
import struct
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import rclpy
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.signals import SignalHandlerOptions

from dopslam_ros.bag import deserialize, serialize
from dopslam_ros.lab.bench.live_nodes import BEGIN, END, PATIENCE, listen, stamp_of
from dopslam_ros.lab.bench.soak import endless_scene
from dopslam_ros.messages import topics
from dopslam_ros.messages.common import Frames
from dopslam_ros.nodes.middleware import middleware_class, qos_profile
from dopslam_ros.nodes.node import LOST
from dopslam_ros.simulation.recording import snapshot_messages
from dopslam_ros.simulation.simulator import simulate

NANO = 1_000_000_000
# Snapshots a second of the scene, whatever the rate they are sent at, and of a round in it.
SCENE_RATE, ROUND = 50.0, 1000
# Sets under way at once while it is found out how many a filter can answer.
UNDER_WAY = 10
# Of that capacity: what is sent before and after the load, and under load.
AT_EASE, TOO_MUCH = 0.2, 10.0
# How often it is looked what is due, and what has come [s].
PERIOD = 0.001
SENT = (topics.ODOMETRY_CONTROL, topics.CHANNEL_MEASUREMENTS)


class Endless:
    """Controls and sets of a vehicle that drives in a circle, as bytes, one step after another."""

    def __init__(self) -> None:
        run = simulate(endless_scene(SCENE_RATE, ROUND), np.random.default_rng(1))
        self._round = [
            {
                topic.name: bytearray(serialize(message, topic.type_name))
                for topic, message in snapshot_messages(snapshot, snapshot.stamp_ns, Frames())
            }
            for snapshot in run
        ]
        self._step = 0

    def next(self) -> tuple[int, list[bytes]]:
        """The stamp of the next step [ns], its control and its set."""
        stamp = NANO + round(self._step * NANO / SCENE_RATE)
        messages = self._round[self._step % ROUND]
        self._step += 1
        return stamp, [stamped(messages[topic.name], stamp) for topic in SENT]


def stamped(payload: bytearray, stamp: int) -> bytes:
    """A serialised message that begins with a header, with another stamp [ns]."""
    order = "<" if payload[1] & 1 else ">"
    struct.pack_into(f"{order}iI", payload, 4, stamp // NANO, stamp % NANO)
    return bytes(payload)


def publishers_of(node: Node) -> list[Publisher]:
    """Those of what is sent, once somebody listens.

    Raises:
        TimeoutError: nobody does.
    """
    made = [
        node.create_publisher(middleware_class(t.type_name), t.name, qos_profile(t.qos))
        for t in SENT
    ]
    end = time.monotonic() + 6.0 * PATIENCE
    while not all(publisher.get_subscription_count() for publisher in made):
        if time.monotonic() > end:
            raise TimeoutError("nobody subscribes to what is sent")
        time.sleep(0.05)
    return made


def feed(rate: str, seconds: str, out: str) -> None:
    """Sends sets at a rate; writes how many, and how long that took [s], as JSON into a file."""
    node, source = Node("feeder"), Endless()
    publishers = publishers_of(node)
    count = round(float(rate) * float(seconds))
    print(BEGIN, flush=True)
    start = time.perf_counter()
    for number in range(count):
        if (left := start + number / float(rate) - time.perf_counter()) > 0.0:
            time.sleep(left)
        for publisher, payload in zip(publishers, source.next()[1], strict=True):
            publisher.publish(payload)
    taken = time.perf_counter() - start
    arrived = all(one.wait_for_all_acked(Duration(seconds=PATIENCE)) for one in publishers)
    print(END, flush=True)
    content = {"sent": count, "seconds": taken, "arrived": arrived}
    Path(out).write_text(json.dumps(content), "utf-8")


def taken(subscription: Any) -> Iterator[tuple[bytes, int]]:
    """What has come to a subscription, with the time that it arrived [ns since the epoch]."""
    with subscription.handle:
        while (message := subscription.handle.take_message(bytes, True)) is not None:
            yield message[0], message[1]["received_timestamp"]


class Phase(NamedTuple):
    """What was sent for a while, and what became of it.

    Attributes:
        seconds: how long.
        sent: when each set was sent [ns since the epoch], by its stamp.
        answered: sets answered in that time.
    """

    seconds: float
    sent: dict[int, int]
    answered: int


class Demanding:
    """Sends sets to a filter node and notes when the answers come.

    Attributes:
        sent: sets so far.
        answers: when the answer to each set came [ns since the epoch], by its stamp.
        told: the last numbers of the diagnostics, by their names.
    """

    def __init__(self) -> None:
        self._node, self._source = Node("demanding"), Endless()
        self.sent = 0
        self.answers: dict[int, int] = {}
        self.told: dict[str, int] = {}
        self._poses, self._diagnostics = (
            listen(self._node, topic, lambda _: None)
            for topic in (topics.UE_POSE, topics.DIAGNOSTICS)
        )
        self._publishers = publishers_of(self._node)
        self.wait_until(lambda: self._node.count_publishers(topics.UE_POSE.name) > 0)

    def _hear(self) -> None:
        """Takes what has come. An executor would take much of the processor from the filter."""
        for payload, arrived in taken(self._poses):
            self.answers[stamp_of(payload)] = arrived
        for payload, _ in taken(self._diagnostics):
            message: Any = deserialize(payload, topics.DIAGNOSTICS.type_name)
            for value in (value for status in message.status for value in status.values):
                if value.value.isdecimal():
                    self.told[value.key] = int(value.value)

    def wait_until(self, condition: Callable[[], bool]) -> None:
        """Listens until something is so, or for long enough."""
        end = time.monotonic() + PATIENCE
        while not condition() and time.monotonic() < end:
            time.sleep(PERIOD)
            self._hear()

    def _send(self, sent: dict[int, int]) -> None:
        stamp, messages = self._source.next()
        self.sent += 1
        sent[stamp] = time.time_ns()
        for publisher, payload in zip(self._publishers, messages, strict=True):
            publisher.publish(payload)

    def one_after_another(self, seconds: float) -> Phase:
        """As many as are answered: only so many are under way at once."""
        return self._phase(seconds, lambda sent, answered, _: UNDER_WAY - sent + answered)

    def at(self, rate: float, seconds: float) -> Phase:
        """So many a second, answered or not."""
        return self._phase(seconds, lambda sent, _, now: round(rate * now) - sent)

    def _phase(self, seconds: float, due: Callable[[int, int, float], int]) -> Phase:
        """Sends what is due by what was sent and answered, and the time since the beginning."""
        sent: dict[int, int] = {}
        start, before = time.perf_counter(), len(self.answers)
        while (now := time.perf_counter() - start) < seconds:
            for _ in range(due(len(sent), len(self.answers) - before, now)):
                self._send(sent)
            time.sleep(PERIOD)
            self._hear()
        return Phase(time.perf_counter() - start, sent, len(self.answers) - before)

    def latencies(self, phase: Phase) -> list[float]:
        """Of the sets that were answered [s]."""
        sent = phase.sent.items()
        return [1e-9 * (self.answers[s] - at) for s, at in sent if s in self.answers]

    def settle(self, phase: Phase) -> None:
        """Waits for the answers that are still due."""
        self.wait_until(lambda: all(stamp in self.answers for stamp in phase.sent))

    def unknown(self) -> int:
        """Sets that the filter says it neither used nor missed."""
        told = ("sets_processed", "problem.overload_dropped", f"problem.{LOST}")
        self.wait_until(lambda: self.sent <= sum(self.told.get(key, 0) for key in told))
        return max(self.sent - sum(self.told.get(key, 0) for key in told), 0)


def overload(brief: str, seconds: str, out: str) -> None:
    """Finds what a filter can answer, sends ten times that, and then little; writes JSON.

    Args:
        brief: how long [s] it is asked what it can do, each time.
        seconds: how long it is asked too much.
        out: the file.
    """
    driver, little = Demanding(), float(brief)
    driver.settle(driver.one_after_another(little))  # for what is done once
    alone = driver.one_after_another(little)
    driver.settle(alone)
    capacity = alone.answered / alone.seconds
    before = driver.at(AT_EASE * capacity, little)
    driver.settle(before)
    print(BEGIN, flush=True)
    load = driver.at(TOO_MUCH * capacity, float(seconds))
    ended = time.time_ns()
    print(END, flush=True)
    after = driver.at(AT_EASE * capacity, little)
    driver.settle(after)
    usual = max(driver.latencies(before))
    as_usual = (
        1e-9 * (at - ended)
        for stamp, at in after.sent.items()
        if 1e-9 * (driver.answers.get(stamp, np.inf) - at) <= usual
    )
    content = {
        "capacity": capacity,
        "sent": len(load.sent) / load.seconds,
        "answered": load.answered / load.seconds,
        "before": driver.latencies(before),
        "under_load": driver.latencies(load),
        "after": driver.latencies(after),
        "recovered": next(as_usual, np.inf),
        "unknown": driver.unknown(),
    }
    Path(out).write_text(json.dumps(content), "utf-8")


ROLES: dict[str, Callable[..., None]] = {"feed": feed, "overload": overload}

if __name__ == "__main__":
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    ROLES[sys.argv[1]](*sys.argv[2:])
