"""Between messages and the core: nothing is lost, and what is drawn is right."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

from dopslam_ros.bag import deserialize, message_class, serialize
from dopslam_ros.core.models.measurements import MeasurementSet
from dopslam_ros.core.models.motion import Control
from dopslam_ros.core.models.refusal import Refused
from dopslam_ros.core.pmb import Associations, FilterParameters, LandmarkEstimates, initial_mixture
from dopslam_ros.core.session.output import FilterOutput
from dopslam_ros.core.settings.layout import DIM, LandmarkType
from dopslam_ros.messages import topics
from dopslam_ros.messages.common import Frames, make_header, read_message, stamp_ns
from dopslam_ros.messages.filter_output import DrawingParameters, FilterMessages
from dopslam_ros.messages.inputs import (
    make_control,
    make_measurements,
    read_control,
    read_measurements,
)
from dopslam_ros.messages.markers import quaternions
from dopslam_ros.messages.states import make_map, make_ue_state, read_map, read_ue_state

BS = np.array([0.0, 0.0, 40.0])
VA, SP = int(LandmarkType.VA), int(LandmarkType.SP)
ADD, DELETE = 0, 2
MAP = topics.LANDMARKS.type_name


def landmarks(*rows: tuple[int, int], seed: int = 0) -> LandmarkEstimates:
    """Landmarks (id, type) with places and covariances of their own."""
    rng = np.random.default_rng(seed)
    ids = np.array([row[0] for row in rows], dtype=np.int64)
    kinds = np.array([row[1] for row in rows], dtype=np.int64)
    roots = rng.normal(size=(len(rows), 3, 3))
    return LandmarkEstimates(
        ids=ids,
        types=kinds,
        type_probabilities=np.eye(3)[kinds],
        existence=np.full(len(rows), 0.75),
        positions=rng.normal(size=(len(rows), 3)) * 100.0,
        covariances=roots @ roots.swapaxes(1, 2),
    )


def output(estimates: LandmarkEstimates, stamp: int = 10**9) -> FilterOutput:
    """What a filter would say."""
    nothing = np.zeros(0, dtype=np.int64)
    made = FilterOutput(
        stamp_ns=stamp,
        state=initial_mixture(FilterParameters()),
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


def said(messages: FilterMessages, estimates: LandmarkEstimates, stamp: int = 10**9) -> Any:
    """The marker array for some landmarks, after a passage through bytes."""
    found = dict((t.name, m) for t, m in messages.of(output(estimates, stamp)))
    type_name = topics.LANDMARK_MARKERS.type_name
    return deserialize(serialize(found[topics.LANDMARK_MARKERS.name], type_name), type_name)


def keys(array: Any, action: int) -> set[tuple[str, int]]:
    """Namespace and id of the markers with an action."""
    found = [(m.ns, m.id) for m in array.markers if m.action == action]
    assert len(set(found)) == len(found)
    return set(found)


def make() -> FilterMessages:
    """A fresh converter."""
    drawing = DrawingParameters(markers_period=0.0)
    return FilterMessages(message_class, BS, 1.5, Frames("world", "car"), drawing)


def test_markers_have_a_namespace_per_type() -> None:
    """A body per landmark in the namespace of its type, an ellipsoid beside it, the id as id."""
    array = said(make(), landmarks((3, VA), (7, SP)))
    assert keys(array, ADD) == {
        ("BS", 0),
        ("VA", 3),
        ("VA_ellipsoid", 3),
        ("SP", 7),
        ("SP_ellipsoid", 7),
    }
    assert keys(array, DELETE) == set()
    assert {m.header.frame_id for m in array.markers} == {"world"}
    assert {stamp_ns(m.header) for m in array.markers} == {10**9}
    assert all(m.lifetime.sec == m.lifetime.nanosec == 0 for m in array.markers)
    assert all(min(m.scale.x, m.scale.y, m.scale.z) > 0.0 for m in array.markers)


def test_markers_keep_their_ids_and_go_with_the_landmark() -> None:
    """A landmark that is gone is deleted once; one that stays is only moved."""
    messages = make()
    said(messages, landmarks((3, VA), (7, SP), (9, SP)))
    second = said(messages, landmarks((3, VA), (9, SP), (12, VA)))
    assert {("VA", 3), ("SP", 9), ("VA", 12), ("BS", 0)} <= keys(second, ADD)
    assert keys(second, DELETE) == {("SP", 7), ("SP_ellipsoid", 7)}
    third = said(messages, landmarks((3, VA), (9, SP), (12, VA)))
    assert keys(third, DELETE) == set()
    assert keys(third, ADD) == keys(second, ADD)
    last = said(messages, landmarks())
    assert keys(last, ADD) == {("BS", 0)}
    assert len(keys(last, DELETE)) == 6
    deleted = [m for m in last.markers if m.action == DELETE]
    assert {m.header.frame_id for m in deleted} == {"world"}


def test_a_landmark_that_changes_its_type_changes_its_namespace() -> None:
    """The marker of the old type is deleted, so that it is not shown twice."""
    messages = make()
    said(messages, landmarks((3, VA)))
    array = said(messages, landmarks((3, SP)))
    assert keys(array, ADD) == {("BS", 0), ("SP", 3), ("SP_ellipsoid", 3)}
    assert keys(array, DELETE) == {("VA", 3), ("VA_ellipsoid", 3)}


@pytest.mark.parametrize("seed", range(5))
def test_ellipsoids_hold_95_percent(seed: int) -> None:
    """The ellipsoid is {x : x' P^-1 x <= chi2(0.95, 3)}, in size and in orientation."""
    from scipy.spatial.transform import Rotation

    estimates = landmarks((4, SP), seed=seed)
    (marker,) = [m for m in said(make(), estimates).markers if m.ns == "SP_ellipsoid"]
    q = marker.pose.orientation
    axes = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
    radii = np.array([marker.scale.x, marker.scale.y, marker.scale.z]) / 2.0
    surface = axes @ np.diag(radii**2) @ axes.T
    assert np.allclose(surface, chi2.ppf(0.95, 3) * estimates.covariances[0], rtol=1e-9)
    p = marker.pose.position
    assert np.array_equal([p.x, p.y, p.z], estimates.positions[0])
    samples = np.random.default_rng(seed).multivariate_normal(
        np.zeros(3), estimates.covariances[0], 40_000
    )
    inside = (np.square(samples @ axes / radii).sum(axis=1) <= 1.0).mean()
    assert abs(inside - 0.95) < 0.006


def test_quaternions_are_those_of_scipy() -> None:
    """Any rotations, and the half turns, in which one component is all there is."""
    from scipy.spatial.transform import Rotation

    halves = [np.diag(turn) for turn in ([1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1])]
    some = Rotation.random(200, random_state=1).as_matrix()
    rotations = np.concatenate([halves, some])
    ours, theirs = quaternions(rotations), Rotation.from_matrix(rotations).as_quat()
    assert np.allclose(ours, theirs, rtol=0.0, atol=1e-15)


def test_the_body_fades_with_the_existence() -> None:
    """How sure a landmark is can be seen: its probability is the opacity."""
    array = said(make(), landmarks((3, VA)))
    opacity = {m.ns: m.color.a for m in array.markers}
    assert opacity["BS"] == 1.0 and opacity["VA"] == 0.75


def test_a_degenerate_covariance_is_drawn() -> None:
    """A covariance with a direction without spread gives a flat ellipsoid, not NaN."""
    estimates = landmarks((3, VA))
    estimates.covariances[0] = np.diag([4.0, 1.0, -1e-18])
    (marker,) = [m for m in said(make(), estimates).markers if m.ns == "VA_ellipsoid"]
    sizes = np.array([marker.scale.x, marker.scale.y, marker.scale.z])
    assert np.isfinite(sizes).all() and sizes.min() == 1e-3


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
    said_.state.best.mean[2] = heading
    found = dict((t.name, m) for t, m in messages.of(said_))
    pose = found[topics.UE_POSE.name].pose.pose
    q = pose.orientation
    assert (q.x, q.y) == (0.0, 0.0)
    assert np.isclose(abs(np.cos(heading / 2) * q.w + np.sin(heading / 2) * q.z), 1.0, atol=1e-12)
    assert pose.position.z == 1.5


def test_measurements_survive_the_passage() -> None:
    """A set through a message and its bytes is the same set, NaN and covariances included."""
    rng = np.random.default_rng(1)
    values = rng.uniform(-1.0, 1.0, (5, 6))
    values[1, 5] = values[3, 2] = np.nan
    roots = rng.normal(size=(5, 6, 6))
    covariances = roots @ roots.swapaxes(1, 2)
    covariances[2] = 0.0
    covariances[3] = 0.5 * (covariances[3] + covariances[3].T)
    before = MeasurementSet(values, covariances)
    type_name = topics.CHANNEL_MEASUREMENTS.type_name
    message = make_measurements(message_class, 123_456_789_012, before, Frames(base="m"))
    again = deserialize(serialize(message, type_name), type_name)
    after = read_measurements(again)
    # Azimuths are wrapped, which may cost them their last bit.
    assert np.allclose(after.values, values, rtol=0.0, atol=1e-15, equal_nan=True)
    measured = np.isfinite(values)
    both = measured[:, :, None] & measured[:, None, :]
    assert np.array_equal(after.covariances, np.where(both, covariances, 0.0))
    assert stamp_ns(again.header) == 123_456_789_012 and again.header.frame_id == "m"
    assert all(np.isnan(path.snr_db) for path in again.paths)


def test_states_maps_and_controls_survive_the_passage() -> None:
    """What goes in comes out: state, covariance, map with its BS, control."""
    rng = np.random.default_rng(2)
    mean, root = rng.normal(size=4), rng.normal(size=(4, 4))
    state = make_ue_state(message_class, 5, mean, root @ root.T, Frames())
    after = read_ue_state(state)
    assert np.array_equal(after[0], mean) and np.array_equal(after[1], root @ root.T)
    estimates = landmarks((3, VA), (7, SP))
    written = serialize(make_map(message_class, 5, estimates, BS, Frames()), MAP)
    arrays = read_map(deserialize(written, MAP))
    assert arrays.ids.tolist() == [0, 3, 7]
    assert arrays.types.tolist() == [LandmarkType.BS, VA, SP]
    assert np.array_equal(arrays.positions, np.vstack([BS, estimates.positions]))
    assert np.array_equal(arrays.covariances[1:], estimates.covariances)
    assert np.array_equal(arrays.of_type(LandmarkType.SP), estimates.positions[1:])
    control = Control(1.25, -0.5)
    assert read_control(make_control(message_class, 5, control, Frames())) == control


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


def test_both_kinds_of_classes_give_the_same_bytes() -> None:
    """The middleware reads and writes what the ROS-free library writes and reads."""
    from rclpy.serialization import deserialize_message, serialize_message

    from dopslam_ros.nodes.middleware import middleware_class

    for topic, message in make().of(output(landmarks((3, VA), (7, SP)))):
        ours = serialize(message, topic.type_name)
        theirs = deserialize_message(ours, middleware_class(topic.type_name))
        back = deserialize(serialize_message(theirs), topic.type_name)
        assert serialize(back, topic.type_name) == ours, topic.name
