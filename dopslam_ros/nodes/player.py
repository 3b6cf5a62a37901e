"""The player node: publishes a bag again, as it was recorded, with the bag's time on /clock."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from rclpy.duration import Duration
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile

from dopslam_ros.bag import BagError, BagMessage, BagReader, Durability, TopicInfo
from dopslam_ros.core.settings.parameters import parameter
from dopslam_ros.messages import topics
from dopslam_ros.messages.common import make_time
from dopslam_ros.nodes.errors import StartError
from dopslam_ros.nodes.joining import STEADY, start_when_joined
from dopslam_ros.nodes.middleware import middleware_class, qos_profile
from dopslam_ros.nodes.node import DopslamNode
from dopslam_ros.nodes.running import serve

TICK = 0.005
# Messages in a tick at most: readers with queues of finite depth must keep up.
MOST_PER_TICK = 100


@dataclass(frozen=True)
class PlayerParameters:
    """Settings of the player."""

    bag: str = parameter("", "The bag to play: its folder or an .mcap file.")
    rate: float = parameter(
        1.0, "How many times faster than recorded.", low=1e-3, high=1e6, dynamic=True
    )
    paused: bool = parameter(False, "Whether time stands still.", dynamic=True)
    outputs: bool = parameter(
        False,
        "Whether to publish also what the filter and the bounds had published, not only what the"
        " filter and the bounds need.",
    )
    clock: bool = parameter(True, "Whether to publish the bag's time on /clock.")
    pause_at_end: bool = parameter(
        False, "Whether to stay, with the latched topics, when everything was published."
    )
    wait_for_nodes: str = parameter(
        "", "Names of nodes, separated by commas, to wait for before the first message."
    )


class PlayerNode(DopslamNode):
    """Publishes the messages of one bag at the times at which they were recorded."""

    def __init__(self, **options: Any) -> None:
        super().__init__("player", **options)
        self._settings = p = self.parameters_of(PlayerParameters)
        if not p.bag:
            raise StartError("parameter 'bag' is empty: give the bag to play (-p bag:=FOLDER)")
        try:
            self._reader = BagReader(Path(p.bag))
        except BagError as error:
            raise StartError(str(error)) from error
        if self._reader.damage:
            self.get_logger().warning(self._reader.damage)
        left_out = set() if p.outputs else topics.output_names(self._reader.topics)
        self._players: dict[str, Publisher] = {}
        for name, info in self._reader.topics.items():
            if name not in left_out:
                self._add(name, info)
        if not self._players:
            raise StartError(f"bag '{p.bag}' has none of the topics to play")
        self._messages = self._reader.messages(self._players)
        self._next: BagMessage | None = next(self._messages, None)
        self._time_ns = self._next.log_time_ns if self._next else 0
        self._sent = 0
        self._tick_ns = 0
        self._clock_publisher = self.create_publisher(
            middleware_class("rosgraph_msgs/msg/Clock"), "/clock", 10
        )
        self.get_logger().info(
            f"ready: {len(self._players)} topics of {p.bag}: {', '.join(sorted(self._players))}"
        )
        start_when_joined(self, p.wait_for_nodes, self._players.values(), self._start)

    def _add(self, name: str, info: TopicInfo) -> None:
        try:
            message_type = middleware_class(info.type_name)
        except (ImportError, AttributeError, ValueError):
            self.get_logger().warning(
                f"{name} is not played: its type {info.type_name} is not installed"
            )
            return
        self._players[name] = self.create_publisher(message_type, name, _offer(info))

    def parameters_changed(self, parameters: Any) -> None:
        self._settings = parameters

    def finished(self) -> bool:
        return self._next is None and not self._settings.pause_at_end

    def close(self) -> None:
        for publisher in self._players.values():
            publisher.wait_for_all_acked(Duration(seconds=2.0))

    def health(self) -> tuple[int, str, list[tuple[str, Any]]]:
        return 0, f"{self._sent} messages published", [("messages_published", self._sent)]

    def _start(self) -> None:
        # The steady clock drives the player: it may well be the source of the ROS time.
        self._tick_ns = STEADY.now().nanoseconds
        self.create_timer(TICK, self._play, clock=STEADY)

    def _play(self) -> None:
        now = STEADY.now().nanoseconds
        elapsed, self._tick_ns = now - self._tick_ns, now
        if self._settings.paused or self._next is None:
            return
        self._time_ns += round(elapsed * self._settings.rate)
        for _ in range(MOST_PER_TICK):
            if self._next is None or self._next.log_time_ns > self._time_ns:
                break
            self._publish_clock(self._next.log_time_ns)
            self._players[self._next.topic].publish(self._next.payload)
            self._sent += 1
            self._next = next(self._messages, None)
        if self._next is not None:
            # More may be due than is sent at once: then time waits.
            self._time_ns = min(self._time_ns, self._next.log_time_ns)
        self._publish_clock(self._time_ns)
        if self._next is None:
            self.get_logger().info(f"end of the bag: {self._sent} messages published")

    def _publish_clock(self, time_ns: int) -> None:
        if self._settings.clock:
            clock = middleware_class("rosgraph_msgs/msg/Clock")
            self._clock_publisher.publish(clock(clock=make_time(middleware_class, time_ns)))


def _offer(info: TopicInfo) -> QoSProfile:
    """The quality of service that a topic was recorded with."""
    offered = info.qos[0] if info.qos else topics.CHANNEL_MEASUREMENTS.qos
    if not offered.depth and offered.durability == Durability.TRANSIENT_LOCAL:
        # Discovery did not tell the depth: who comes late gets the last one, not the whole past.
        offered = replace(offered, depth=1)
    return qos_profile(offered)


def main() -> None:
    """ros2 run dopslam_ros player."""
    serve(PlayerNode)


if __name__ == "__main__":
    main()
