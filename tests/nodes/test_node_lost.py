"""A filter node whose vehicle is carried away: it says so on /diagnostics, and that it is back."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from dopslam_ros.bag import message_class, serialize
from dopslam_ros.messages import topics
from dopslam_ros.messages.common import Frames
from dopslam_ros.messages.inputs import make_control, make_measurements
from dopslam_ros.nodes.filter import FilterNode
from dopslam_ros.nodes.middleware import middleware_class, qos_profile
from dopslam_ros.simulation.scenario import load_scenario
from dopslam_ros.simulation.simulator import Snapshot, simulate

if TYPE_CHECKING:
    from tests.conftest import Ros

SETS, CONTROLS = topics.CHANNEL_MEASUREMENTS, topics.ODOMETRY_CONTROL
# Sets before it, in a place that the map knows nothing of, and back in another corner of the map.
BEFORE, ELSEWHERE, AFTER = 25, 6, 20
OK, ERROR = 0, 2  # of diagnostic_msgs/DiagnosticStatus
AWAY = np.array([20.0, 0.0, 0.5, 0.0])  # [m, m, rad, m]


def carried_away() -> list[Snapshot]:
    """A drive through a strange place, from which the vehicle comes back to where it was not."""
    rng = np.random.default_rng(7)
    scene = load_scenario("paper")
    turned = scene.landmarks[:, [1, 0, 2]] * (0.7, -1.6, 1.0) + (35.0, -20.0, 0.0)
    strange = replace(scene, bs_position=(60.0, -45.0, 10.0), landmarks=turned)
    drive = list(simulate(scene, rng))[:BEFORE]
    moved = tuple(drive[-1].state + AWAY)
    for world, sets in ((strange, ELSEWHERE), (scene, AFTER)):
        there = replace(
            world, controls=scene.controls[:sets], initial_state=moved, initial_std=(1e-9,) * 4
        )
        shift = len(drive) * scene.period_ns
        drive += [replace(s, stamp_ns=s.stamp_ns + shift) for s in simulate(there, rng)]
    return drive


def test_a_vehicle_that_is_lost_and_found(ros: Ros) -> None:
    """OK before, an ERROR with the reason while it is lost, OK again where it really is."""
    heard = ros.listen(topics.UE_STATE, topics.DIAGNOSTICS)
    node = ros.start(FilterNode)
    feeder = ros.node("feeder")
    outputs: dict[topics.Topic, Any] = {
        t: feeder.create_publisher(middleware_class(t.type_name), t.name, qos_profile(t.qos))
        for t in (CONTROLS, SETS)
    }
    for publisher in outputs.values():
        ros.spin_until(lambda p=publisher: p.get_subscription_count() == 1)
    ros.spin_until(
        lambda: all(node.count_subscribers(n) == 1 for n in ("ue_state", "/diagnostics"))
    )
    told: list[Any] = []
    drive = carried_away()
    for number, s in enumerate(drive, start=1):
        control = make_control(message_class, s.stamp_ns, s.control, Frames())
        paths = make_measurements(message_class, s.stamp_ns, s.measurements, Frames())
        outputs[CONTROLS].publish(serialize(control, CONTROLS.type_name))
        outputs[SETS].publish(serialize(paths, SETS.type_name))
        ros.spin_until(lambda n=number: heard.count(topics.UE_STATE) == n)
        so_far = heard.count(topics.DIAGNOSTICS)
        node.publish_diagnostics()
        ros.spin_until(lambda n=so_far: heard.count(topics.DIAGNOSTICS) > n)
        (status,) = heard.messages(topics.DIAGNOSTICS)[-1].status
        told.append((status.level, status.message, {v.key: v.value for v in status.values}))

    def position(n: int) -> np.ndarray:
        state = heard.messages(topics.UE_STATE)[n]
        return np.array([state.x, state.y])

    level, message, values = told[BEFORE - 1]
    assert level == OK and "OK: as expected" in message and values["times_lost"] == "0"
    lost = [entry for entry in told[BEFORE : BEFORE + ELSEWHERE] if entry[0] == ERROR]
    assert lost
    for _, message, values in lost:
        assert "LOST: lost: " in message and values["health"] == "LOST"
    level, message, values = told[-1]
    assert level == OK and values["health"] == "OK" and int(values["times_lost"]) > 0
    assert np.linalg.norm(position(-1) - drive[-1].state[:2]) < 2.0
