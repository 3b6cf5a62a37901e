"""Nodes that get messages faster than they can process them."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from dopslam_ros.bag import message_class, serialize
from dopslam_ros.core.models.motion import Control
from dopslam_ros.messages import topics
from dopslam_ros.messages.common import Frames
from dopslam_ros.messages.inputs import make_control, make_measurements
from dopslam_ros.nodes.bounds import BoundsNode
from dopslam_ros.nodes.filter import FilterNode
from dopslam_ros.nodes.middleware import READING_DEPTH, middleware_class, qos_profile
from dopslam_ros.nodes.node import DopslamNode
from dopslam_ros.simulation.scenario import load_scenario
from dopslam_ros.simulation.simulator import simulate

if TYPE_CHECKING:
    from tests.conftest import Ros

SETS, CONTROLS = topics.CHANNEL_MEASUREMENTS, topics.ODOMETRY_CONTROL
MOST = 20
BURST = 300


def test_too_many_sets_at_once(ros: Ros) -> None:
    """The oldest of those that wait are dropped and counted, the newest are used, then all is well.

    The node gets no turn while the burst is sent, as if each of its steps took as long.
    """
    (snapshot,) = list(simulate(load_scenario("paper"), np.random.default_rng(1)))[:1]

    def stamps_of_messages(k: int) -> tuple[bytes, bytes]:
        stamp = 1_000_000_000 + k * 10_000_000
        control = make_control(message_class, stamp, Control(0.0, 0.0), Frames())
        paths = make_measurements(message_class, stamp, snapshot.measurements, Frames())
        return serialize(control, CONTROLS.type_name), serialize(paths, SETS.type_name)

    heard = ros.listen(topics.UE_STATE)
    node = ros.start(FilterNode, most_waiting=MOST)
    feeder = ros.node("feeder")
    control, paths = (
        feeder.create_publisher(middleware_class(t.type_name), t.name, qos_profile(t.qos))
        for t in (CONTROLS, SETS)
    )
    for publisher in (control, paths):
        ros.spin_until(lambda p=publisher: p.get_subscription_count() == 1)
    ros.spin_until(lambda: node.count_subscribers("ue_state") == 1)

    def send(first: int, count: int) -> None:
        for k in range(first, first + count):
            for publisher, payload in zip((control, paths), stamps_of_messages(k), strict=True):
                publisher.publish(payload)

    def all_told() -> int:
        return heard.count(topics.UE_STATE) + int(node.problems["overload_dropped"])

    send(0, BURST)
    time.sleep(0.5)
    ros.spin_until(lambda: all_told() == BURST)
    # What was dropped is known to the last set; what was not has its answer, in order.
    used = heard.count(topics.UE_STATE)
    assert MOST <= used <= BURST // 2
    stamps = [
        m.header.stamp.nanosec + 10**9 * m.header.stamp.sec for m in heard.messages(topics.UE_STATE)
    ]
    assert stamps == sorted(stamps)
    newest = [1_000_000_000 + k * 10_000_000 for k in range(BURST - MOST, BURST)]
    assert stamps[-MOST:] == newest
    send(BURST, 10)
    ros.spin_until(lambda: heard.count(topics.UE_STATE) == used + 10)
    assert set(node.problems) <= {"overload_dropped", "overload_dropped_control"}
    assert node.problems["overload_dropped"] == BURST - used
    values = dict(node.health()[2])
    assert values["sets_waiting"] == 0


@pytest.mark.parametrize("node_type", [FilterNode, BoundsNode])
def test_what_the_middleware_lost_is_counted(ros: Ros, node_type: type[DopslamNode]) -> None:
    """More come than its queue holds before the node gets a turn: it says how many."""
    node: Any = ros.start(node_type)
    feeder = ros.node("feeder")
    publisher = feeder.create_publisher(
        middleware_class(CONTROLS.type_name), CONTROLS.name, qos_profile(CONTROLS.qos)
    )
    ros.spin_until(lambda: publisher.get_subscription_count() == 1)

    def send(first: int, count: int) -> None:
        for k in range(first, first + count):
            control = make_control(message_class, 10**9 + k * 10**6, Control(1.0, 0.0), Frames())
            publisher.publish(serialize(control, CONTROLS.type_name))

    used: list[int] = []
    session, add = node._session, node._session.add_control
    session.add_control = lambda stamp, *control: used.append(stamp) or add(stamp, *control)
    send(0, 1)
    ros.spin_until(lambda: len(used) == 1)
    send(1, READING_DEPTH + 500)

    def told() -> int:
        return sum(node.problems[r] for r in ("lost_by_middleware", "overload_dropped_control"))

    ros.spin_until(lambda: len(used) + told() == READING_DEPTH + 501)
    assert node.problems["lost_by_middleware"] == 500
