"""Quality of service: the notation of rosbag2, with rosbags and rclpy as witnesses."""

from __future__ import annotations

import pytest
import rclpy.qos
from rclpy.duration import Duration, Infinite
from rosbags.rosbag2.metadata import dump_qos_v9, parse_qos

from dopslam_ros.bag import (
    INFINITE_NS,
    BagFormatError,
    Durability,
    History,
    Liveliness,
    OfferedQos,
    Reliability,
    from_profile,
    from_yaml,
    to_yaml,
)

DISCOVERED = """\
- history: unknown
  depth: 0
  reliability: reliable
  durability: transient_local
  deadline:
    sec: 9223372036
    nsec: 854775807
  lifespan:
    sec: 10
    nsec: 0
  liveliness: automatic
  liveliness_lease_duration:
    sec: 9223372036
    nsec: 854775807
  avoid_ros_namespace_conventions: false"""

OF_VERSION_4 = """\
- history: 1
  depth: 10
  reliability: 1
  durability: 2
  deadline: {sec: 2147483647, nsec: 4294967295}
  lifespan: {sec: 2147483647, nsec: 2147483647}
  liveliness: 0
  liveliness_lease_duration: {sec: 0, nsec: 5}
  avoid_ros_namespace_conventions: true
"""


def test_text_is_that_of_rosbag2() -> None:
    rosout = OfferedQos(
        history=History.UNKNOWN, depth=0, durability=Durability.TRANSIENT_LOCAL, lifespan=10**10
    )
    assert to_yaml([rosout]) == DISCOVERED
    assert to_yaml([rosout, rosout]) == f"{DISCOVERED}\n{DISCOVERED}"
    assert to_yaml([]) == "[]"


def test_rosbags_reads_every_policy_as_it_was_meant() -> None:
    times = {"deadline": 1, "lifespan": 2 * 10**9 + 3, "liveliness_lease": 5}
    profiles = [
        *(OfferedQos(history=policy, **times) for policy in History),
        *(OfferedQos(reliability=policy, **times) for policy in Reliability),
        *(OfferedQos(durability=policy, **times) for policy in Durability),
        *(OfferedQos(liveliness=policy, **times) for policy in Liveliness),
    ]
    parsed = parse_qos(to_yaml(profiles))
    assert [p.history.value for p in parsed] == [p.history for p in profiles]
    assert [p.reliability.value for p in parsed] == [p.reliability for p in profiles]
    assert [p.durability.value for p in parsed] == [p.durability for p in profiles]
    assert [p.liveliness.value for p in parsed] == [p.liveliness for p in profiles]
    assert {p.lifespan for p in parsed} == {(2, 3)}
    assert from_yaml(to_yaml(profiles)) == tuple(profiles)
    assert to_yaml(from_yaml(str(dump_qos_v9(parsed)))) == to_yaml(profiles)


def test_old_notation_and_old_infinities() -> None:
    (profile,) = from_yaml(OF_VERSION_4)
    assert profile == OfferedQos(
        History.KEEP_LAST,
        10,
        Reliability.RELIABLE,
        Durability.VOLATILE,
        INFINITE_NS,
        INFINITE_NS,
        Liveliness.SYSTEM_DEFAULT,
        5,
        avoid_ros_namespace_conventions=True,
    )


def test_unknown_policies_become_unknown() -> None:
    (named,) = from_yaml(DISCOVERED.replace("reliability: reliable", "reliability: prayer"))
    (numbered,) = from_yaml(OF_VERSION_4.replace("durability: 2", "durability: 77"))
    assert named.reliability is Reliability.UNKNOWN
    assert numbered.durability is Durability.UNKNOWN


@pytest.mark.parametrize("text", ["", "[]", "~"])
def test_no_profiles(text: str) -> None:
    assert from_yaml(text) == ()


@pytest.mark.parametrize("text", ["5", "- 5", "a: b", "- history: keep_last", "[", "\0"])
def test_nonsense_is_refused(text: str) -> None:
    with pytest.raises(BagFormatError, match=r"QoS profile|offered_qos_profiles"):
        from_yaml(text)


def test_profiles_of_rclpy() -> None:
    profile = rclpy.qos.QoSProfile(
        depth=50,
        reliability=rclpy.qos.ReliabilityPolicy.BEST_EFFORT,
        durability=rclpy.qos.DurabilityPolicy.TRANSIENT_LOCAL,
        deadline=Duration(seconds=1.5),
        lifespan=Infinite,
        liveliness=rclpy.qos.LivelinessPolicy.MANUAL_BY_TOPIC,
    )
    assert from_profile(profile) == OfferedQos(
        depth=50,
        reliability=Reliability.BEST_EFFORT,
        durability=Durability.TRANSIENT_LOCAL,
        deadline=1_500_000_000,
        lifespan=INFINITE_NS,
        liveliness=Liveliness.MANUAL_BY_TOPIC,
        liveliness_lease=0,
    )


@pytest.mark.parametrize(
    ("ours", "theirs"),
    [
        (History, rclpy.qos.HistoryPolicy),
        (Reliability, rclpy.qos.ReliabilityPolicy),
        (Durability, rclpy.qos.DurabilityPolicy),
        (Liveliness, rclpy.qos.LivelinessPolicy),
    ],
)
def test_numbers_are_those_of_rclpy(ours: type, theirs: type) -> None:
    for policy in theirs:  # type: ignore[attr-defined]
        assert ours(policy.value).name == policy.name
