"""A filter node on simulated time, whose clock jumps back as at a bag that is played again."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from dopslam_ros.bag import message_class, serialize
from dopslam_ros.messages import topics
from dopslam_ros.messages.common import Frames
from dopslam_ros.messages.inputs import make_control, make_measurements
from dopslam_ros.nodes.filter import FilterNode
from dopslam_ros.nodes.middleware import middleware_class, qos_profile
from dopslam_ros.simulation.scenario import load_scenario
from dopslam_ros.simulation.simulator import simulate

if TYPE_CHECKING:
    from tests.conftest import Ros

SETS, CONTROLS = topics.CHANNEL_MEASUREMENTS, topics.ODOMETRY_CONTROL
STEPS = 14  # 6.5 s: further back than stamps are merely late
SECOND = 1_000_000_000


def test_a_clock_that_jumps_back(ros: Ros) -> None:
    """The filter begins anew and says so; its timers and diagnostics go on, on the new time."""
    from rosgraph_msgs.msg import Clock

    heard = ros.listen(topics.UE_STATE, topics.DIAGNOSTICS)
    node = ros.start(FilterNode, use_sim_time=True)
    feeder = ros.node("feeder")
    clock = feeder.create_publisher(Clock, "/clock", 10)
    outputs: dict[topics.Topic, Any] = {
        t: feeder.create_publisher(middleware_class(t.type_name), t.name, qos_profile(t.qos))
        for t in (CONTROLS, SETS)
    }
    for publisher in (clock, *outputs.values()):
        ros.spin_until(lambda p=publisher: p.get_subscription_count() == 1)
    ros.spin_until(
        lambda: all(node.count_subscribers(n) == 1 for n in ("ue_state", "/diagnostics"))
    )
    run = list(simulate(load_scenario("paper"), np.random.default_rng(4)))[:STEPS]

    def set_clock(time_ns: int) -> None:
        message = Clock()
        message.clock.sec, message.clock.nanosec = divmod(time_ns, SECOND)
        clock.publish(message)
        ros.spin_until(lambda: node.get_clock().now().nanoseconds == time_ns)

    def play(answers: int) -> None:
        for s in run:
            set_clock(s.stamp_ns)
            control = make_control(message_class, s.stamp_ns, s.control, Frames())
            paths = make_measurements(message_class, s.stamp_ns, s.measurements, Frames())
            outputs[CONTROLS].publish(serialize(control, CONTROLS.type_name))
            outputs[SETS].publish(serialize(paths, SETS.type_name))
        ros.spin_until(lambda: heard.count(topics.UE_STATE) == answers)

    play(STEPS)
    play(2 * STEPS)
    states = heard.bytes(topics.UE_STATE)
    assert states[STEPS:] == states[:STEPS]

    # A set whose control never comes is not waited for longer than this clock says.
    stamp = run[-1].stamp_ns + SECOND // 2
    late = make_measurements(message_class, stamp, run[-1].measurements, Frames())
    outputs[SETS].publish(serialize(late, SETS.type_name))
    ros.spin_until(lambda: dict(node.health()[2])["sets_waiting"] == 1)
    for tick in range(1, 4):
        set_clock(stamp + tick * SECOND)
    ros.spin_until(lambda: heard.count(topics.UE_STATE) == 2 * STEPS + 1)

    # Told without a call, by the timer, and with the time of the new round.
    before = heard.count(topics.DIAGNOSTICS)
    ros.spin_until(lambda: heard.count(topics.DIAGNOSTICS) > before + 1)
    told = heard.messages(topics.DIAGNOSTICS)[-1]
    values = {v.key: v.value for v in told.status[0].values}
    assert values["problem.reset_backward_jump"] == "1"
    assert values["problem.missing_control"] == "1"
    assert told.header.stamp.sec * SECOND + told.header.stamp.nanosec == stamp + 3 * SECOND
