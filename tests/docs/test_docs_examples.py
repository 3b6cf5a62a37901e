"""The examples of the documentation run as they are printed there."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dopslam_ros.bag import BagReader, deserialize
from dopslam_ros.messages import topics
from dopslam_ros.nodes.filter import FilterNode

if TYPE_CHECKING:
    from tests.conftest import Ros

EXAMPLE = Path(__file__).resolve().parents[2] / "docs" / "examples" / "channel_estimator.py"
LIGHT = 299792458.0


def snapshots(bag: Path) -> list[dict[str, Any]]:
    """What a channel estimator would have to say about a simulated run."""
    found: dict[str, list[Any]] = {topics.CHANNEL_MEASUREMENTS.name: [], "odometry_control": []}
    for message in BagReader(bag).messages({"/" + name for name in found}):
        found[message.topic.strip("/")].append(deserialize(message.payload, message.type_name))
    return [
        {
            "speed": control.twist.linear.x,
            "turn_rate": control.twist.angular.z,
            "paths": [
                [p.path_length / LIGHT, p.aoa_azimuth, p.aoa_elevation, p.doppler]
                for p in snapshot.paths
            ],
        }
        for control, snapshot in zip(
            found["odometry_control"], found[topics.CHANNEL_MEASUREMENTS.name], strict=True
        )
    ]


def test_the_channel_estimator_feeds_the_filter(ros: Ros, simulated: Path) -> None:
    """A process of its own hands a run to the filter, which processes every set of it.

    All at once, so that the vehicle stands still for the filter: what goes in is judged here, not
    where the vehicle is said to be.
    """
    run = snapshots(simulated)
    listener = ros.listen(topics.CHANNEL_MEASUREMENTS, topics.UE_STATE)
    node = ros.start(FilterNode, initial_std=[30.0, 30.0, 3.0, 30.0])
    process = subprocess.Popen(
        [sys.executable, str(EXAMPLE)],
        stdin=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "ROS_DOMAIN_ID": str(ros.domain)},
    )
    try:
        assert process.stdin is not None
        process.stdin.write("".join(json.dumps(snapshot) + "\n" for snapshot in run))
        process.stdin.close()
        ros.spin_until(lambda: listener.count(topics.UE_STATE) == len(run), 120.0)
        ros.spin_until(lambda: process.poll() is not None)
    finally:
        process.kill()
    assert process.returncode == 0, process.stderr and process.stderr.read()
    for message, snapshot in zip(listener.messages(topics.CHANNEL_MEASUREMENTS), run, strict=True):
        assert len(message.paths) == len(snapshot["paths"])
        for path, (delay, azimuth, _, doppler) in zip(
            message.paths, snapshot["paths"], strict=True
        ):
            np.testing.assert_allclose(path.path_length, delay * LIGHT)
            assert (path.aoa_azimuth, path.doppler) == (azimuth, doppler)
            assert np.isnan(path.aod_azimuth) and not path.covariance.any()
    assert not node.problems
