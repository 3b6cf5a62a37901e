"""The middleware's forms of what a topic is: class of its messages, quality of service."""

from __future__ import annotations

import importlib
from dataclasses import replace
from functools import cache
from typing import Any

from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from dopslam_ros.bag import serialize
from dopslam_ros.bag.qos import OfferedQos
from dopslam_ros.messages import topics

# Messages that wait for a subscriber that is busy.
READING_DEPTH = 1000


@cache
def middleware_class(type_name: str) -> Any:
    """rclpy's class of ``package/msg/Name``."""
    package, kind, name = type_name.split("/")
    return getattr(importlib.import_module(f"{package}.{kind}"), name)


def qos_profile(offered: OfferedQos) -> QoSProfile:
    """rclpy's form of a quality of service."""
    # Discovery knows neither history nor depth of others: keep plenty.
    depth = offered.depth or READING_DEPTH
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy(int(offered.reliability)),
        durability=DurabilityPolicy(int(offered.durability)),
    )


def reading_profile(topic: topics.Topic, depth: int = READING_DEPTH) -> QoSProfile:
    """The quality of service to read a topic with.

    As it is offered, but with a deep queue: of a latched topic one message is kept for those who
    come late, while somebody who is there wants to miss none.
    """
    return qos_profile(replace(topic.qos, depth=max(topic.depth, depth)))


class Output:
    """A publisher of messages made by ``bag.message_class``.

    They are serialised here, by the code that the offline replay uses too, and handed to the
    middleware as bytes: what a live run publishes and what its replay writes is then equal byte for
    byte, even where CDR leaves gaps for alignment, which the middleware's own serialiser does not
    clear.
    """

    def __init__(self, publisher: Publisher, type_name: str) -> None:
        self.publisher = publisher
        self._type_name = type_name

    def publish(self, message: Any) -> None:
        """Serialises and sends."""
        self.publisher.publish(serialize(message, self._type_name))
