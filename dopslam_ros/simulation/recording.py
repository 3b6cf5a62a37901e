"""Writes a simulated run straight into a bag, without any middleware."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from dopslam_ros.bag import BagWriter, message_class, serialize
from dopslam_ros.core.settings.parameters import commented_yaml
from dopslam_ros.messages import topics
from dopslam_ros.messages.common import Frames, make_text
from dopslam_ros.messages.inputs import make_control, make_measurements
from dopslam_ros.messages.states import make_map, make_ue_state, true_landmarks
from dopslam_ros.simulation.matched import filter_parameters_for
from dopslam_ros.simulation.scenario import Scenario
from dopslam_ros.simulation.simulator import Snapshot, simulate
from dopslam_ros.system.stopping import until_stopped

Message = tuple[topics.Topic, Any]


def map_message(scenario: Scenario, time_ns: int, frames: Frames) -> Message:
    """The true landmarks of a scenario."""
    estimates = true_landmarks(scenario.landmarks, scenario.landmark_types)
    return topics.TRUTH_LANDMARKS, make_map(message_class, time_ns, estimates, scenario.bs, frames)


def snapshot_messages(snapshot: Snapshot, time_ns: int, frames: Frames) -> list[Message]:
    """Everything that is published at a snapshot, the control first: the filter waits for it."""
    no_error = np.zeros((len(snapshot.state), len(snapshot.state)))
    return [
        (
            topics.ODOMETRY_CONTROL,
            make_control(message_class, time_ns, snapshot.control, frames),
        ),
        (
            topics.TRUTH_UE,
            make_ue_state(message_class, time_ns, snapshot.state, no_error, frames),
        ),
        (
            topics.CHANNEL_MEASUREMENTS,
            make_measurements(message_class, time_ns, snapshot.measurements, frames),
        ),
    ]


def write_simulation(
    scenario: Scenario,
    seed: int,
    writer: BagWriter,
    progress: Callable[[Iterable[Snapshot]], Iterable[Snapshot]] = iter,
) -> int:
    """A run of a scenario as the simulator node would publish it; the same bytes for a seed.

    The models of the scenario go into the bag as the filter's parameters, so that a replay uses
    them. Ctrl-C ends the run if it is within a Stop.

    Returns:
        The number of snapshots.

    Raises:
        BagError: the bag cannot be written.
    """
    frames = Frames()
    start = scenario.stamp_ns(0)
    parameters = commented_yaml(filter_parameters_for(scenario))

    def write(message: Message, time_ns: int) -> None:
        topic, content = message
        name = "/" + topic.name
        writer.add_topic(name, topic.type_name, qos=[topic.qos])
        writer.write(name, serialize(content, topic.type_name), time_ns)

    write((topics.FILTER_PARAMETERS, make_text(message_class, parameters)), start)
    write(map_message(scenario, start, frames), start)
    count = 0
    for snapshot in until_stopped(progress(simulate(scenario, np.random.default_rng(seed)))):
        for message in snapshot_messages(snapshot, snapshot.stamp_ns, frames):
            write(message, snapshot.stamp_ns)
        count += 1
    return count
