"""What all messages share: how bytes are read, times, frames and geometry.

The same code builds messages for the middleware and for bags: it gets a function that finds the
class of a message type: bag.message_class, or the middleware's.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from dopslam_ros.bag import BagTypeError, deserialize
from dopslam_ros.core.models.measurements import MOST_PATHS
from dopslam_ros.core.models.motion import Control
from dopslam_ros.core.models.refusal import Refused
from dopslam_ros.messages import topics

Types = Callable[[str], Any]
NANO = 1_000_000_000
# Longest set [bytes] that is looked into: more than MOST_PATHS paths take.
LARGEST_MESSAGE = 1024 * MOST_PATHS


class InvalidMessage(Refused):
    """A message that cannot be used."""


@dataclass(frozen=True)
class Frames:
    """Names of the coordinate frames."""

    map: str = "map"
    base: str = "base_link"


def stamp_ns(header: Any) -> int:
    """Time of a header [ns].

    Raises:
        InvalidMessage: the stamp is zero or malformed.
    """
    sec, nanosec = int(header.stamp.sec), int(header.stamp.nanosec)
    if (sec, nanosec) == (0, 0):
        raise InvalidMessage(
            "no_stamp", "header.stamp is zero: fill in the time of the snapshot or control"
        )
    if sec < 0 or not 0 <= nanosec < NANO:
        raise InvalidMessage("invalid_stamp", f"header.stamp {sec} s {nanosec} ns is no time")
    return sec * NANO + nanosec


def make_header(types: Types, time_ns: int, frame: str) -> Any:
    """std_msgs/Header."""
    return types("std_msgs/msg/Header")(stamp=make_time(types, time_ns), frame_id=frame)


def make_time(types: Types, time_ns: int) -> Any:
    """builtin_interfaces/Time."""
    return types("builtin_interfaces/msg/Time")(sec=time_ns // NANO, nanosec=time_ns % NANO)


def read_message(payload: bytes, topic: topics.Topic) -> Any:
    """The message that bytes from a topic or a bag hold.

    Raises:
        InvalidMessage: they hold none of the topic's type, or a set that is too large.
    """
    if topic == topics.CHANNEL_MEASUREMENTS and len(payload) > LARGEST_MESSAGE:
        raise InvalidMessage(
            "message_too_large",
            f"a set of {len(payload)} bytes: at most {LARGEST_MESSAGE} are read, and {MOST_PATHS}"
            " paths used: send the strongest",
        )
    try:
        return deserialize(payload, topic.type_name)
    except BagTypeError as error:
        raise InvalidMessage("malformed_message", str(error)) from error


def make_text(types: Types, text: str) -> Any:
    """A std_msgs/String."""
    return types("std_msgs/msg/String")(data=text)


def make_point(types: Types, position: Sequence[float]) -> Any:
    """geometry_msgs/Point from (3,) [m]."""
    x, y, z = position
    return types("geometry_msgs/msg/Point")(x=x, y=y, z=z)


def make_quaternion(types: Types, quaternion: Sequence[float]) -> Any:
    """geometry_msgs/Quaternion from (4,) x, y, z, w."""
    x, y, z, w = quaternion
    return types("geometry_msgs/msg/Quaternion")(x=x, y=y, z=z, w=w)


def make_vector(types: Types, vector: Sequence[float]) -> Any:
    """geometry_msgs/Vector3 from (3,)."""
    x, y, z = vector
    return types("geometry_msgs/msg/Vector3")(x=x, y=y, z=z)


def make_twist(types: Types, control: Control) -> Any:
    """geometry_msgs/Twist of a vehicle that moves along its heading."""
    return types("geometry_msgs/msg/Twist")(
        linear=make_vector(types, (float(control.speed), 0.0, 0.0)),
        angular=make_vector(types, (0.0, 0.0, float(control.turn_rate))),
    )
