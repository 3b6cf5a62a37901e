"""What the filter node publishes after a step."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_maps import BS, SP, VA, landmarks

from dopslam_ros.bag import deserialize, message_class, serialize
from dopslam_ros.core.models.measurements import MeasurementSet
from dopslam_ros.core.models.motion import Control
from dopslam_ros.core.pmb import (
    Associations,
    FilterParameters,
    LandmarkEstimates,
    initial_posterior,
)
from dopslam_ros.core.session.output import FilterOutput
from dopslam_ros.core.settings.layout import DIM
from dopslam_ros.messages import topics
from dopslam_ros.messages.common import Frames
from dopslam_ros.messages.filter_output import DrawingParameters, FilterMessages


def output(estimates: LandmarkEstimates, stamp: int = 10**9) -> FilterOutput:
    """What a filter would say."""
    nothing = np.zeros(0, dtype=np.int64)
    made = FilterOutput(
        stamp_ns=stamp,
        state=initial_posterior(FilterParameters()),
        parameters=FilterParameters(),
        control=Control(3.0, -0.5),
        measurements=MeasurementSet(np.zeros((0, DIM)), np.zeros((0, DIM, DIM))),
        associations=Associations(
            nothing.reshape(0, 0),
            np.zeros(0),
            nothing,
            0.0,
            0,
            0.0,
            nothing,
            np.zeros(0),
            np.zeros(0),
        ),
        step_seconds=0.0,
    )
    vars(made)["landmarks"] = estimates  # as if it had been asked for before
    return made


def make() -> FilterMessages:
    """A fresh converter."""
    drawing = DrawingParameters(markers_period=0.0)
    return FilterMessages(message_class, BS, 1.5, Frames("world", "car"), drawing)


def test_the_path_is_bounded() -> None:
    """Of a long drive the newest poses stay, and a message once made does not change."""
    messages = FilterMessages(message_class, BS, drawing=DrawingParameters(3, 1.0, 1.0))
    paths = []
    for number in range(1, 6):
        found = dict((t.name, m) for t, m in messages.of(output(landmarks(), number * 10**9)))
        paths.append(found[topics.PATH.name])
    seconds = [[p.header.stamp.sec for p in path.poses] for path in paths]
    assert seconds == [[1], [1, 2], [1, 2, 3], [2, 3, 4], [3, 4, 5]]


def test_the_path_ends_where_the_estimation_begins_anew() -> None:
    """After a reset no line leads from the old place to the new one."""
    messages = FilterMessages(message_class, BS, drawing=DrawingParameters(9, 0.0, 0.0))
    lengths = []
    for number, anew in enumerate([True, False, False, True, False]):
        one = replace(output(landmarks(), 10**9 + number), anew=anew)
        found = {topic.name: message for topic, message in messages.of(one)}
        lengths.append(len(found[topics.PATH.name].poses))
    assert lengths == [1, 2, 3, 1, 2]


def test_what_is_only_drawn_is_paced_by_the_time_of_the_sets() -> None:
    """At 100 Hz: a path every 2 s, markers every 1 s; state and map each time."""
    messages = FilterMessages(message_class, BS)
    sent: dict[str, list[int]] = {}
    poses = []
    for number in range(401):
        for topic, message in messages.of(output(landmarks((1, VA)), 10**9 + number * 10**7)):
            sent.setdefault(topic.name, []).append(number)
            if topic == topics.PATH:
                poses.append(len(message.poses))
    assert sent[topics.PATH.name] == [0, 200, 400]
    assert poses == [1, 5, 9]  # one every 0.5 s
    assert sent[topics.LANDMARK_MARKERS.name] == [0, 100, 200, 300, 400]
    assert len(sent[topics.UE_STATE.name]) == len(sent[topics.LANDMARKS.name]) == 401
    # A recording that begins anew is shown at once.
    names = [topic.name for topic, _ in messages.of(output(landmarks(), 10**9))]
    assert topics.PATH.name in names


@pytest.mark.parametrize("heading", [0.0, 1.0, -2.5, np.pi, -np.pi + 1e-9])
def test_the_pose_points_where_the_vehicle_does(heading: float) -> None:
    """The quaternion of each heading: half the angle about z, of length one."""
    messages, said_ = make(), output(landmarks())
    said_.state.density.mean[2] = heading
    found = dict((t.name, m) for t, m in messages.of(said_))
    pose = found[topics.UE_POSE.name].pose.pose
    q = pose.orientation
    assert (q.x, q.y) == (0.0, 0.0)
    assert np.isclose(abs(np.cos(heading / 2) * q.w + np.sin(heading / 2) * q.z), 1.0, atol=1e-12)
    assert pose.position.z == 1.5


def test_both_kinds_of_classes_give_the_same_bytes() -> None:
    """The middleware reads and writes what the ROS-free library writes and reads."""
    from rclpy.serialization import deserialize_message, serialize_message

    from dopslam_ros.nodes.middleware import middleware_class

    for topic, message in make().of(output(landmarks((3, VA), (7, SP)))):
        ours = serialize(message, topic.type_name)
        theirs = deserialize_message(ours, middleware_class(topic.type_name))
        back = deserialize(serialize_message(theirs), topic.type_name)
        assert serialize(back, topic.type_name) == ours, topic.name
