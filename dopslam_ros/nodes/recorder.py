"""The recorder node: writes the topics of a run into an MCAP bag, byte for byte."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

from rclpy.exceptions import NameValidationException
from rclpy.qos import QoSProfile

from dopslam_ros.bag import BagError, BagWriteError, BagWriter
from dopslam_ros.bag.qos import from_profile
from dopslam_ros.core.models.refusal import Refused
from dopslam_ros.core.settings.parameters import parameter
from dopslam_ros.messages import topics
from dopslam_ros.nodes.errors import StartError
from dopslam_ros.nodes.inbox import Inbox
from dopslam_ros.nodes.joining import STEADY, names
from dopslam_ros.nodes.middleware import middleware_class, qos_profile, reading_profile
from dopslam_ros.nodes.node import LOST, DopslamNode
from dopslam_ros.nodes.running import RCLError, serve

FLUSH_PERIOD = 0.5
DISCOVERY_PERIOD = 0.5
# Messages of a topic that may wait while the disk is slow.
MOST_WAITING = 5000


@dataclass(frozen=True)
class RecorderParameters:
    """Settings of the recorder."""

    bag: str = parameter("", "Folder of the new bag; empty: rosbag2_ and the time, here.")
    extra_topics: str = parameter(
        "", "More topics to record, separated by commas; their types are found in the graph."
    )


class RecorderNode(DopslamNode):
    """Records the topics of this package, and others on request."""

    def __init__(self, **options: Any) -> None:
        super().__init__("recorder", **options)
        p = self.parameters_of(RecorderParameters)
        self._extra = [self._topic(name) for name in names(p.extra_topics)]
        path = Path(p.bag or f"rosbag2_{datetime.now():%Y_%m_%d-%H_%M_%S}")
        try:
            self._bag = BagWriter(path, fsync_seconds=5.0)
        except BagError as error:
            raise StartError(str(error)) from error
        self._written = self._lost = 0
        self._failure = ""
        self._subscribed: set[str] = set()
        self._known: set[str] = set()
        self._inbox = Inbox(self, MOST_WAITING, self._on_overload, self.miss)
        # The controls last: see nodes.joining.
        recorded = (topics.FILTER_EVENTS, *topics.RECORDED)
        for topic in sorted(recorded, key=lambda t: t == topics.ODOMETRY_CONTROL):
            name = self.resolve_topic_name(topic.name)
            self._record(name, topic.type_name, reading_profile(topic, MOST_WAITING))
        self.create_timer(FLUSH_PERIOD, self._flush, clock=STEADY)
        if self._extra:
            self.create_timer(DISCOVERY_PERIOD, self._discover, clock=STEADY)
        self.get_logger().info(f"ready: recording into {path}")

    def _topic(self, name: str) -> str:
        try:
            return self.resolve_topic_name(name)
        except (NameValidationException, RCLError) as error:
            raise StartError(
                f"parameter 'extra_topics': '{name}' is no name of a topic: {error}"
            ) from error

    def _record(self, name: str, type_name: str, qos: QoSProfile) -> None:
        self._subscribed.add(name)
        write = partial(self._write, name, type_name)
        self._inbox.listen(middleware_class(type_name), name, qos, write)

    def _discover(self) -> None:
        """Subscribes to the extra topics as their publishers appear, as these offer them."""
        types = dict(self.get_topic_names_and_types())
        for name in self._extra:
            offers = self.get_publishers_info_by_topic(name)
            if name not in self._subscribed and offers and name in types:
                try:
                    offered = qos_profile(from_profile(offers[0].qos_profile))
                    self._record(name, types[name][0], offered)
                except (ImportError, AttributeError) as error:
                    self._subscribed.add(name)
                    self.refuse(name, error)

    def _write(self, name: str, type_name: str, payload: bytes) -> None:
        if self._failure:
            self._lost += 1
            return
        now = self.get_clock().now().nanoseconds
        try:
            if name not in self._known:
                offers = self.get_publishers_info_by_topic(name)
                qos = {from_profile(offer.qos_profile) for offer in offers}
                self._bag.add_topic(name, type_name, qos=sorted(qos, key=repr))
                self._known.add(name)
            self._bag.write(name, payload, now)
            self._written += 1
        except BagWriteError as error:  # a full disk must not end the run
            self._refused(name, error)
        except BagError as error:
            self.refuse(name, error)

    def _flush(self) -> None:
        if not self._failure:
            try:
                self._bag.flush()
            except BagWriteError as error:
                self._refused("bag", error)

    def _refused(self, source: str, error: BagWriteError) -> None:
        """A message that the bag did not take; when it takes no more, that is said as an error."""
        if self._bag.closed:
            self._lost += 1
            self._failure = str(error)
            self.get_logger().error(self._failure)
        self.refuse(source, error)

    def _on_overload(self, topic: str, count: int) -> None:
        self._lost += count
        text = f"more than {MOST_WAITING} wait: record on a faster disk, or give more processor"
        self.refuse(topic, Refused("overload_dropped", text), count)

    def health(self) -> tuple[int, str, list[tuple[str, Any]]]:
        values: list[tuple[str, Any]] = [
            ("messages_written", self._written),
            ("messages_lost", self._lost + self.problems[LOST]),
            ("topics", len(self._known)),
        ]
        if self._failure:
            return 2, self._failure, values
        return 0, f"{self._written} messages written", values

    def close(self) -> None:
        self._inbox.empty()
        try:
            self._bag.close()
            self.get_logger().info(f"closed {self._bag.path}: {self._written} messages")
        except BagError as error:
            self.get_logger().error(str(error))


def main() -> None:
    """ros2 run dopslam_ros recorder."""
    serve(RecorderNode)


if __name__ == "__main__":
    main()
