"""The processes around the filter node when it is measured: who sends, who listens, who relays.

``python -m dopslam_ros.lab.bench.live_nodes driver|relay|listener`` with arguments of their own.
"""

from __future__ import annotations

import json
import signal
import struct
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from dopslam_ros.bag import serialize
from dopslam_ros.messages import topics
from dopslam_ros.messages.common import Frames
from dopslam_ros.nodes.middleware import middleware_class, qos_profile, reading_profile
from dopslam_ros.simulation.recording import snapshot_messages
from dopslam_ros.simulation.scenario import Scenario, load_scenario
from dopslam_ros.simulation.simulator import simulate

RELAYED = topics.CHANNEL_MEASUREMENTS._replace(name="relayed")
ANSWERS = {"filter": topics.UE_POSE, "relay": RELAYED}
# What a driver says on its standard output before and after the sets that count.
BEGIN, END = "begin", "end"
# Sets sent before those that count [s], and how long the last answers may take [s].
WARM_UP_SECONDS, PATIENCE = 1.0, 10.0


def scene(rate: float, steps: int) -> Scenario:
    """The paper's scene with snapshots in quick succession."""
    paper = load_scenario("paper")
    return replace(paper, period=1.0 / rate, controls=paper.controls[:1] * steps)


class Driver:
    """Sends controls and sets at a rate and notes when the answers come.

    Args:
        of: who answers, "filter" or "relay".
    """

    def __init__(self, of: str) -> None:
        self.node = Node("driver")
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)
        self._publishers = {
            topic.name: self.node.create_publisher(
                middleware_class(topic.type_name), topic.name, qos_profile(topic.qos)
            )
            for topic in (topics.ODOMETRY_CONTROL, topics.CHANNEL_MEASUREMENTS)
        }
        self.sent: dict[int, float] = {}
        self.received: dict[int, float] = {}
        answer = ANSWERS[of]
        self._subscription = self.node.create_subscription(
            middleware_class(answer.type_name),
            answer.name,
            self._on_answer,
            reading_profile(answer),
            raw=True,
        )

    def _on_answer(self, payload: bytes) -> None:
        self.received[stamp_of(payload)] = time.perf_counter()

    def wait(self) -> None:
        """Until somebody answers.

        Raises:
            TimeoutError: nobody is there.
        """
        end = time.monotonic() + 6.0 * PATIENCE
        while not (
            all(publisher.get_subscription_count() for publisher in self._publishers.values())
            and self.node.count_publishers(self._subscription.topic_name)
        ):
            if time.monotonic() > end:
                raise TimeoutError("nobody subscribes to what the driver sends")
            self._executor.spin_once(timeout_sec=0.05)

    def send(self, sets: list[tuple[int, dict[str, bytes]]], rate: float) -> None:
        """Publishes sets, controls first, at a steady rate."""
        start = time.perf_counter()
        for number, (stamp, messages) in enumerate(sets):
            due = start + number / rate
            while (left := due - time.perf_counter()) > 0.0:
                self._executor.spin_once(timeout_sec=left)
            self._publishers[topics.ODOMETRY_CONTROL.name].publish(
                messages[topics.ODOMETRY_CONTROL.name]
            )
            self.sent[stamp] = time.perf_counter()
            self._publishers[topics.CHANNEL_MEASUREMENTS.name].publish(
                messages[topics.CHANNEL_MEASUREMENTS.name]
            )

    def finish(self) -> None:
        """Waits for the answers that are still due."""
        end = time.monotonic() + PATIENCE
        while len(self.received) < len(self.sent) and time.monotonic() < end:
            self._executor.spin_once(timeout_sec=0.05)


def stamp_of(payload: bytes) -> int:
    """Time [ns] of a serialised message that begins with a header."""
    order = "<" if payload[1] & 1 else ">"
    sec, nanosec = struct.unpack_from(f"{order}iI", payload, 4)
    return int(sec) * 1_000_000_000 + int(nanosec)


def sets_of(rate: float, steps: int) -> list[tuple[int, dict[str, bytes]]]:
    """A simulated run as serialised messages by topic, with the stamp of each snapshot."""
    return [
        (
            snapshot.stamp_ns,
            {
                topic.name: serialize(message, topic.type_name)
                for topic, message in snapshot_messages(snapshot, snapshot.stamp_ns, Frames())
            },
        )
        for snapshot in simulate(scene(rate, steps), np.random.default_rng(1))
    ]


def drive(of: str, rate: str, seconds: str, out: str) -> None:
    """Writes the latencies [s] and the number of sets lost as JSON into a file."""
    settling = round(WARM_UP_SECONDS * float(rate))
    sets = sets_of(float(rate), settling + round(float(rate) * float(seconds)))
    driver = Driver(of)
    driver.wait()
    driver.send(sets[:settling], float(rate))
    driver.finish()
    driver.sent.clear()
    driver.received.clear()
    print(BEGIN, flush=True)
    driver.send(sets[settling:], float(rate))
    driver.finish()
    print(END, flush=True)
    latencies = [driver.received[s] - driver.sent[s] for s in driver.sent if s in driver.received]
    content = {"latencies": latencies, "lost": len(driver.sent) - len(latencies)}
    Path(out).write_text(json.dumps(content), "utf-8")


def relay() -> None:
    """Hands every set on as it came, and nothing else."""
    node: Any = Node("relay")
    publisher = node.create_publisher(
        middleware_class(RELAYED.type_name), RELAYED.name, qos_profile(RELAYED.qos)
    )
    listen(node, topics.CHANNEL_MEASUREMENTS, publisher.publish)
    listen(node, topics.ODOMETRY_CONTROL, lambda _: None)
    node.get_logger().info("ready")
    spin(node)


def listener(out: str) -> None:
    """Subscribes to all that the filter says; writes how many messages came as JSON into a file."""
    node: Any = Node("listener")
    count = {topic.name: 0 for topic in topics.OUTPUTS if topic != topics.BOUNDS}

    def counter(name: str) -> Any:
        def one_more(_: bytes) -> None:
            count[name] += 1

        return one_more

    for topic in topics.OUTPUTS:
        if topic.name in count:
            listen(node, topic, counter(topic.name))
    node.get_logger().info("ready")
    spin(node)
    Path(out).write_text(json.dumps(count), "utf-8")


def listen(node: Node, topic: topics.Topic, callback: Any) -> Any:
    """A subscription to the bytes of a topic."""
    kind = middleware_class(topic.type_name)
    return node.create_subscription(kind, topic.name, callback, reading_profile(topic), raw=True)


def spin(node: Node) -> None:
    """Until SIGTERM."""
    stopped = False

    def stop(number: int, frame: FrameType | None) -> None:
        nonlocal stopped
        stopped = True

    signal.signal(signal.SIGTERM, stop)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    while not stopped:
        executor.spin_once(timeout_sec=0.2)


ROLES: dict[str, Callable[..., None]] = {"driver": drive, "relay": relay, "listener": listener}

if __name__ == "__main__":
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    ROLES[sys.argv[1]](*sys.argv[2:])
