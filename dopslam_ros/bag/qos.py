"""Quality of service that publishers offered, in the notation of rosbag2 (metadata version 9).

The numbers of the policies are those of the middleware interface, which rclpy uses as well:
``rclpy.qos.HistoryPolicy(offered.history)`` converts.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import IntEnum
from functools import cache, lru_cache
from typing import Any, TypeVar

import yaml

from dopslam_ros.bag.errors import BagFormatError

INFINITE_NS = 2**63 - 1
"""Duration [ns] that means "without limit"."""

_SECOND_NS = 10**9
_INFINITE_OF_OLD_BAGS = {(0x7FFFFFFF, 0xFFFFFFFF), (0x7FFFFFFF, 0x7FFFFFFF)}


class History(IntEnum):
    """How many samples a publisher keeps."""

    SYSTEM_DEFAULT = 0
    KEEP_LAST = 1
    KEEP_ALL = 2
    UNKNOWN = 3


class Reliability(IntEnum):
    """Whether lost samples are sent again."""

    SYSTEM_DEFAULT = 0
    RELIABLE = 1
    BEST_EFFORT = 2
    UNKNOWN = 3
    BEST_AVAILABLE = 4


class Durability(IntEnum):
    """Whether late subscribers get samples published before they came."""

    SYSTEM_DEFAULT = 0
    TRANSIENT_LOCAL = 1
    VOLATILE = 2
    UNKNOWN = 3
    BEST_AVAILABLE = 4


class Liveliness(IntEnum):
    """How a publisher shows that it is alive."""

    SYSTEM_DEFAULT = 0
    AUTOMATIC = 1
    MANUAL_BY_NODE = 2
    MANUAL_BY_TOPIC = 3
    UNKNOWN = 4
    BEST_AVAILABLE = 5


@dataclass(frozen=True)
class OfferedQos:
    """What one publisher of a topic offered.

    Attributes:
        history: Samples kept; discovery over DDS reports ``UNKNOWN``.
        depth: Number of samples kept with ``KEEP_LAST``; discovery reports 0.
        reliability: Reliable or best effort.
        durability: Volatile or transient local.
        deadline: Longest time between two samples [ns]; 0 or ``INFINITE_NS``: none.
        lifespan: Age after which a sample expires [ns]; 0 or ``INFINITE_NS``: never.
        liveliness: How the publisher asserts that it is alive.
        liveliness_lease: Time within which it must do so [ns].
        avoid_ros_namespace_conventions: Topic name used in DDS without ROS's prefix.
    """

    history: History = History.KEEP_LAST
    depth: int = 10
    reliability: Reliability = Reliability.RELIABLE
    durability: Durability = Durability.VOLATILE
    deadline: int = INFINITE_NS
    lifespan: int = INFINITE_NS
    liveliness: Liveliness = Liveliness.AUTOMATIC
    liveliness_lease: int = INFINITE_NS
    avoid_ros_namespace_conventions: bool = False


def to_yaml(profiles: Iterable[OfferedQos]) -> str:
    """Write profiles as rosbag2 does in the channel metadata ``offered_qos_profiles``.

    Args:
        profiles: Profiles of the publishers of one topic.

    Returns:
        A YAML list without a newline at its end; ``[]`` when there are no profiles.
    """
    return _to_yaml(tuple(profiles))


@cache
def _to_yaml(profiles: tuple[OfferedQos, ...]) -> str:
    """Most topics of a bag have the same."""
    return str(yaml.safe_dump(to_data(profiles), sort_keys=False)).strip()


def to_data(profiles: Iterable[OfferedQos]) -> list[dict[str, object]]:
    """Write profiles as the lists and dictionaries that ``metadata.yaml`` contains."""
    return [_profile_to_data(profile) for profile in profiles]


@lru_cache(maxsize=256)
def from_yaml(text: str) -> tuple[OfferedQos, ...]:
    """Read profiles from the text in the metadata of a channel.

    Both notations are understood: names (version 9) and numbers (up to version 8). A policy that
    is not known becomes ``UNKNOWN``.

    Args:
        text: YAML list; an empty text means no profiles.

    Raises:
        BagFormatError: The text is no YAML, or not a list of profiles.
    """
    try:
        return from_data(yaml.safe_load(text))
    except yaml.YAMLError as error:
        raise BagFormatError(f"offered_qos_profiles is not valid YAML: {error}") from error


def from_data(data: object) -> tuple[OfferedQos, ...]:
    """Read profiles from the lists and dictionaries that ``metadata.yaml`` contains.

    Args:
        data: List of profiles; None or empty means none.

    Raises:
        BagFormatError: It is not a list of profiles.
    """
    if not data:
        return ()
    if not isinstance(data, list):
        raise BagFormatError(f"offered_qos_profiles is not a list: {data!r:.100}")
    return tuple(_profile_from_data(item) for item in data)


def from_profile(profile: Any) -> OfferedQos:
    """Convert a ``rclpy.qos.QoSProfile``, or anything with its attributes.

    Args:
        profile: Object with the attributes ``history``, ``depth``, ``reliability``,
            ``durability``, ``deadline``, ``lifespan``, ``liveliness`` and
            ``liveliness_lease_duration``, where durations have ``nanoseconds``.
    """
    return OfferedQos(
        history=History(int(profile.history)),
        depth=int(profile.depth),
        reliability=Reliability(int(profile.reliability)),
        durability=Durability(int(profile.durability)),
        deadline=int(profile.deadline.nanoseconds),
        lifespan=int(profile.lifespan.nanoseconds),
        liveliness=Liveliness(int(profile.liveliness)),
        liveliness_lease=int(profile.liveliness_lease_duration.nanoseconds),
        avoid_ros_namespace_conventions=bool(profile.avoid_ros_namespace_conventions),
    )


def _profile_to_data(profile: OfferedQos) -> dict[str, object]:
    return {
        "history": profile.history.name.lower(),
        "depth": profile.depth,
        "reliability": profile.reliability.name.lower(),
        "durability": profile.durability.name.lower(),
        "deadline": _time_to_data(profile.deadline),
        "lifespan": _time_to_data(profile.lifespan),
        "liveliness": profile.liveliness.name.lower(),
        "liveliness_lease_duration": _time_to_data(profile.liveliness_lease),
        "avoid_ros_namespace_conventions": profile.avoid_ros_namespace_conventions,
    }


def _profile_from_data(data: Any) -> OfferedQos:
    try:
        return OfferedQos(
            history=_policy(History, data["history"]),
            depth=int(data["depth"]),
            reliability=_policy(Reliability, data["reliability"]),
            durability=_policy(Durability, data["durability"]),
            deadline=_time_from_data(data["deadline"]),
            lifespan=_time_from_data(data["lifespan"]),
            liveliness=_policy(Liveliness, data["liveliness"]),
            liveliness_lease=_time_from_data(data["liveliness_lease_duration"]),
            avoid_ros_namespace_conventions=bool(data["avoid_ros_namespace_conventions"]),
        )
    except (KeyError, TypeError, ValueError) as error:
        problem = f"not a QoS profile ({type(error).__name__}: {error}): {data!r:.200}"
        raise BagFormatError(problem) from error


_Policy = TypeVar("_Policy", History, Reliability, Durability, Liveliness)


def _policy(kind: type[_Policy], value: object) -> _Policy:
    """Read a policy by name or number; what nobody knows is UNKNOWN."""
    names: Mapping[str, _Policy] = kind.__members__
    if isinstance(value, str):
        return names.get(value.upper(), kind["UNKNOWN"])
    return next((policy for policy in names.values() if policy == value), kind["UNKNOWN"])


def _time_to_data(nanoseconds: int) -> dict[str, int]:
    seconds, rest = divmod(nanoseconds, _SECOND_NS)
    return {"sec": seconds, "nsec": rest}


def _time_from_data(data: Any) -> int:
    seconds, nanoseconds = int(data["sec"]), int(data["nsec"])
    if (seconds, nanoseconds) in _INFINITE_OF_OLD_BAGS:
        return INFINITE_NS
    return seconds * _SECOND_NS + nanoseconds
