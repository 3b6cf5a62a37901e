"""Stamps and bytes that cannot be used."""

from __future__ import annotations

import pytest

from dopslam_ros.bag import message_class
from dopslam_ros.core.models.refusal import Refused
from dopslam_ros.messages import topics
from dopslam_ros.messages.common import make_header, read_message, stamp_ns


@pytest.mark.parametrize(
    ("sec", "nanosec", "reason"),
    [(0, 0, "no_stamp"), (-1, 0, "invalid_stamp"), (1, 10**9, "invalid_stamp")],
)
def test_impossible_stamps(sec: int, nanosec: int, reason: str) -> None:
    """A stamp that is no time is refused with its reason; the first instant after zero is one."""
    header = make_header(message_class, 1, "map")
    assert stamp_ns(header) == 1
    header.stamp.sec, header.stamp.nanosec = sec, nanosec
    with pytest.raises(Refused) as error:
        stamp_ns(header)
    assert error.value.reason == reason


def test_bytes_that_are_no_message() -> None:
    """The error says how many bytes of what they are not."""
    with pytest.raises(Refused, match=r"3 bytes are no dopslam_msgs/msg/UeState") as error:
        read_message(b"abc", topics.UE_STATE)
    assert error.value.reason == "malformed_message"
