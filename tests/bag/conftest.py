"""Bags and messages that several tests use."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from dopslam_ros.bag import BagWriter, OfferedQos

UE_STATE = "dopslam_msgs/msg/UeState"
ODOMETRY = "nav_msgs/msg/Odometry"


class Sample(NamedTuple):
    """A message to be written and found again."""

    topic: str
    log_time_ns: int
    publish_time_ns: int
    payload: bytes


def _samples(count: int) -> list[Sample]:
    rng = np.random.default_rng(1)
    return [
        Sample(
            "/odometry" if rng.random() < 0.3 else "/state",
            10**18 + 10**7 * number,
            10**18 + 10**7 * number - 1000,
            b"\0\1\0\0" + rng.bytes(int(rng.integers(0, 400))),
        )
        for number in range(count)
    ]


def _write(path: Path, samples: Sequence[Sample], chunk_bytes: int = 8192) -> Path:
    with BagWriter(path, chunk_bytes=chunk_bytes, flush_seconds=None) as writer:
        writer.add_topic("/state", UE_STATE, qos=[OfferedQos(depth=50)])
        writer.add_topic("/odometry", ODOMETRY)
        for sample in samples:
            writer.write(sample.topic, sample.payload, sample.log_time_ns, sample.publish_time_ns)
    return path


@pytest.fixture
def samples() -> list[Sample]:
    """Three hundred messages on two topics, 10 ms apart."""
    return _samples(300)


@pytest.fixture
def write_bag() -> Callable[..., Path]:
    """Function ``(path, samples, chunk_bytes=8192)`` that writes samples to a new bag."""
    return _write
