"""Simulator to filter to bounds through real rclpy executors."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from dopslam_ros.bag import BagReader, message_class, serialize
from dopslam_ros.core.linalg.arrays import wrap_angle
from dopslam_ros.core.session.bounding import BoundsSession
from dopslam_ros.core.settings.bounding import BoundsParameters
from dopslam_ros.core.settings.layout import LandmarkType
from dopslam_ros.messages import topics
from dopslam_ros.messages.common import Frames, stamp_ns
from dopslam_ros.messages.states import make_bounds, read_map, read_ue_state
from dopslam_ros.nodes.bounds import BoundsNode
from dopslam_ros.nodes.filter import FilterNode
from dopslam_ros.nodes.middleware import Output, middleware_class, qos_profile
from dopslam_ros.nodes.recorder import RecorderNode
from dopslam_ros.nodes.simulator import SimulatorNode
from dopslam_ros.simulation.scenario import load_scenario

if TYPE_CHECKING:
    from tests.conftest import LiveRun, Ros

STEPS = 8
LATCHED = (
    topics.LANDMARKS,
    topics.PATH,
    topics.LANDMARK_MARKERS,
    topics.TRUTH_LANDMARKS,
    topics.FILTER_PARAMETERS,
)


def by_stamp(messages: list[Any]) -> dict[int, Any]:
    """Messages by their stamp [ns]."""
    return {stamp_ns(message.header): message for message in messages}


def test_every_topic_has_its_messages(live: LiveRun) -> None:
    """Each topic brings one message a snapshot, or one altogether, and nothing is lost."""
    once = {topics.TRUTH_LANDMARKS.name, topics.FILTER_PARAMETERS.name}
    for topic in (*topics.INPUTS, *topics.OUTPUTS):
        assert len(live.heard[topic.name]) == (1 if topic.name in once else STEPS), topic.name
    assert live.heard[topics.DIAGNOSTICS.name]


def test_the_graph_knows_every_topic_with_its_type(ros: Ros, scene: Path) -> None:
    """The nodes offer exactly the topics of the list, each with its type."""
    ros.start(SimulatorNode, scenario=str(scene))
    ros.start(FilterNode)
    ros.start(BoundsNode)
    watcher = ros.node("watcher")

    def found() -> dict[str, list[str]]:
        return dict(watcher.get_topic_names_and_types())

    expected = {"/" + t.name.lstrip("/"): [t.type_name] for t in topics.RECORDED}
    ros.spin_until(lambda: expected.keys() <= found().keys())
    assert {name: found()[name] for name in expected} == expected


def test_state_of_every_snapshot(live: LiveRun) -> None:
    """Every set gets its state, with its stamp, in order, in the frame of the map."""
    sets = [stamp_ns(m.header) for m in live.messages(topics.CHANNEL_MEASUREMENTS)]
    states = live.messages(topics.UE_STATE)
    period = load_scenario("paper").period_ns
    assert sets == [1_000_000_000 + n * period for n in range(STEPS)]
    assert [stamp_ns(m.header) for m in states] == sets
    assert {m.header.frame_id for m in states} == {"world"}
    for message in states:
        mean, covariance = read_ue_state(message)
        assert -np.pi < mean[2] <= np.pi
        assert np.array_equal(covariance, covariance.T)
        assert np.linalg.eigvalsh(covariance)[0] > 0.0


def test_pose_and_odometry_say_what_the_state_says(live: LiveRun) -> None:
    """Pose, its covariance and its quaternion are the state's; the twist is the control's."""
    poses = by_stamp(live.messages(topics.UE_POSE))
    odometry = by_stamp(live.messages(topics.ODOMETRY))
    controls = by_stamp(live.messages(topics.ODOMETRY_CONTROL))
    states = live.messages(topics.UE_STATE)
    assert len(states) == STEPS
    for state in states:
        stamp = stamp_ns(state.header)
        mean, covariance = read_ue_state(state)
        for message in (poses[stamp], odometry[stamp]):
            pose = message.pose.pose
            assert (pose.position.x, pose.position.y, pose.position.z) == (mean[0], mean[1], 0.0)
            q = pose.orientation
            rotation = Rotation.from_quat([q.x, q.y, q.z, q.w])
            heading = rotation.as_euler("xyz")[2]
            assert abs(wrap_angle(np.array(heading - mean[2]))) < 1e-12
            assert np.allclose(rotation.apply([0.0, 0.0, 1.0]), [0.0, 0.0, 1.0])
            assert message.header.frame_id == "world"
            # REP-103: x, y, z, roll, pitch, yaw, row-major.
            expected = np.zeros((6, 6))
            expected[np.ix_([0, 1, 5], [0, 1, 5])] = covariance[:3, :3]
            assert np.array_equal(np.reshape(message.pose.covariance, (6, 6)), expected)
        twist, control = odometry[stamp].twist.twist, controls[stamp].twist
        assert odometry[stamp].child_frame_id == "m"
        assert (twist.linear.x, twist.angular.z) == (control.linear.x, control.angular.z)
        assert twist.linear.x == 22.22
        assert (twist.linear.y, twist.linear.z, twist.angular.x, twist.angular.y) == (0, 0, 0, 0)


def test_path_holds_the_poses_so_far(live: LiveRun) -> None:
    """The n-th path has the first n poses, each with its frame and its stamp."""
    poses = live.messages(topics.UE_POSE)
    for count, path in enumerate(live.messages(topics.PATH), start=1):
        assert [p.header for p in path.poses] == [p.header for p in poses[:count]]
        assert [p.pose for p in path.poses] == [p.pose.pose for p in poses[:count]]
        assert path.header == poses[count - 1].header


def test_truth_is_the_scene(live: LiveRun) -> None:
    """The true map is the scenario's, the BS with id 0; the true states carry no covariance."""
    (message,) = live.messages(topics.TRUTH_LANDMARKS)
    truth, scenario = read_map(message), load_scenario("paper")
    assert truth.ids.tolist() == list(range(9))
    assert truth.types.tolist() == [LandmarkType.BS, *scenario.landmark_types.tolist()]
    assert np.array_equal(truth.positions, np.vstack([scenario.bs, scenario.landmarks]))
    for state in live.messages(topics.TRUTH_UE):
        assert not read_ue_state(state)[1].any()


def test_estimates_are_near_the_truth(live: LiveRun) -> None:
    """Against the truth all errors are finite and of the size the filter itself gives."""
    truth = by_stamp(live.messages(topics.TRUTH_UE))
    nees = []
    for message in live.messages(topics.UE_STATE):
        mean, covariance = read_ue_state(message)
        error = mean - read_ue_state(truth[stamp_ns(message.header)])[0]
        error[2] = wrap_angle(error[2])
        assert np.hypot(error[0], error[1]) < 3.0
        nees.append(error @ np.linalg.solve(covariance, error))
    assert 0.0 < np.mean(nees) < 12.0
    found = read_map(live.messages(topics.LANDMARKS)[-1])
    assert (found.types == LandmarkType.VA).sum() >= 3


def test_landmarks_keep_their_ids(live: LiveRun) -> None:
    """The BS is always there with id 0; an id whose type stays stays near its place."""
    seen: dict[tuple[int, int], np.ndarray] = {}
    for message in live.messages(topics.LANDMARKS):
        current = read_map(message)
        assert current.ids[0] == 0 and current.types[0] == LandmarkType.BS
        assert len(set(current.ids.tolist())) == len(current.ids)
        keys = zip(current.ids.tolist(), current.types.tolist(), strict=True)
        for key, position in zip(keys, current.positions, strict=True):
            assert np.linalg.norm(seen.get(key, position) - position) < 20.0
            seen[key] = position
    assert len(seen) > 3


def test_bounds_are_those_of_the_session(live: LiveRun) -> None:
    """The node publishes, byte for byte, what BoundsSession says about truth and controls."""
    session = BoundsSession(BoundsParameters())
    (truth,) = live.messages(topics.TRUTH_LANDMARKS)
    true_map = read_map(truth)
    controls = live.messages(topics.ODOMETRY_CONTROL)
    states = live.messages(topics.TRUTH_UE)
    outputs = []
    for control, state in zip(controls, states, strict=True):
        twist = control.twist
        stamp = stamp_ns(control.header)
        outputs += session.add_control(stamp, twist.linear.x, twist.angular.z)
        outputs += session.add_world(stamp_ns(state.header), true_map.at(read_ue_state(state)[0]))
    expected = [
        serialize(make_bounds(message_class, o, Frames("world")), topics.BOUNDS.type_name)
        for o in outputs
    ]
    assert live.heard[topics.BOUNDS.name] == expected


def test_bounds_make_sense(live: LiveRun) -> None:
    """Doppler helps; a landmark never seen reports infinity and the others a finite bound."""
    bounds = live.messages(topics.BOUNDS)
    for message in bounds:
        assert 0.0 < message.peb <= message.peb_without_doppler < 2.0
        assert 0.0 < message.heb <= message.heb_without_doppler
        assert 0.0 < message.ceb <= message.ceb_without_doppler
        assert [m.id for m in message.landmarks] == list(range(1, 9))
    last = {m.id: m.leb for m in bounds[-1].landmarks}
    assert all(np.isfinite(last[number]) for number in (1, 2, 3, 4, 5))
    assert all(np.isinf(last[number]) for number in (6, 8))


def test_bounds_at_the_estimate(ros: Ros, simulated: Path) -> None:
    """Without a truth the bounds are evaluated at the filter's estimate, once a snapshot."""
    filtering, bounding = ros.start(FilterNode), ros.start(BoundsNode)
    listener = ros.listen(topics.BOUNDS, topics.UE_STATE)
    inputs = (topics.CHANNEL_MEASUREMENTS, topics.ODOMETRY_CONTROL)
    feeder = ros.node("feeder")
    outputs = {
        "/" + t.name: Output(
            feeder.create_publisher(middleware_class(t.type_name), t.name, qos_profile(t.qos)),
            t.type_name,
        )
        for t in inputs
    }
    ros.spin_until(
        lambda: (
            outputs["/channel_measurements"].publisher.get_subscription_count() == 1
            and outputs["/odometry_control"].publisher.get_subscription_count() == 2
            and filtering.count_subscribers("ue_state") == 2
        )
    )
    for message in BagReader(simulated).messages(set(outputs)):
        outputs[message.topic].publisher.publish(message.payload)
    ros.spin_until(lambda: listener.count(topics.BOUNDS) == STEPS)
    assert not bounding.problems
    bounds = listener.messages(topics.BOUNDS)
    stamps = [stamp_ns(m.header) for m in listener.messages(topics.UE_STATE)]
    assert [stamp_ns(m.header) for m in bounds] == stamps
    assert all(0.0 < m.peb < 2.0 for m in bounds)


def test_the_pose_as_a_transform(
    ros: Ros, scene: Path, tmp_path: Path, bag_payloads: Callable[..., list[bytes]]
) -> None:
    """With publish_tf, and recorded where it is asked for: what the odometry says."""
    listener = ros.listen(topics.TF, topics.ODOMETRY)
    recording = ros.start(RecorderNode, bag=str(tmp_path / "bag"), extra_topics="/tf")
    node = ros.start(FilterNode, publish_tf=True, map_frame="world", base_frame="car")
    ros.spin_until(
        lambda: node.count_subscribers("/tf") == 2 and node.count_subscribers("odometry") == 2
    )
    ros.start(SimulatorNode, scenario=str(scene), rate=50.0, wait_for_nodes="filter,recorder")
    ros.spin_until(lambda: listener.count(topics.TF) == STEPS == listener.count(topics.ODOMETRY))
    said = zip(listener.messages(topics.TF), listener.messages(topics.ODOMETRY), strict=True)
    for transforms, odometry in said:
        (one,) = transforms.transforms
        assert one.header == odometry.header and one.header.frame_id == "world"
        assert one.child_frame_id == odometry.child_frame_id == "car"
        moved, pose = one.transform.translation, odometry.pose.pose
        assert (moved.x, moved.y, moved.z) == (pose.position.x, pose.position.y, pose.position.z)
        assert one.transform.rotation == pose.orientation
    ros.spin_until(lambda: BagReader(tmp_path / "bag").topics["/tf"].message_count == STEPS)
    ros.remove(recording)
    assert bag_payloads(tmp_path / "bag", topics.TF) == listener.bytes(topics.TF)


def test_no_transform_unless_asked_for(ros: Ros) -> None:
    """Somebody else may publish it."""
    node = ros.start(FilterNode)
    assert node.count_publishers("ue_state") == 1 and node.count_publishers("/tf") == 0


def test_a_late_subscriber_gets_the_map(ros: Ros, scene: Path) -> None:
    """Who joins after the run gets the last map, path, markers, true map and the settings."""
    early = ros.listen(topics.LANDMARK_MARKERS, topics.ODOMETRY_CONTROL, *LATCHED[:2])
    filtering = ros.start(FilterNode, path_period=0.0, path_spacing=0.0, markers_period=0.0)
    simulating = ros.start(
        SimulatorNode,
        scenario=str(scene),
        rate=50.0,
        exit_when_done=False,
        wait_for_nodes="filter,listener",
    )
    ros.spin_until(lambda: early.count(topics.LANDMARK_MARKERS) == STEPS)
    late = ros.listen(*LATCHED, name="late")
    ros.spin_until(lambda: all(late.count(topic) for topic in LATCHED))
    for topic in LATCHED[:3]:
        assert late.bytes(topic) == early.bytes(topic)[-1:]
    assert "gamma: 10" in late.messages(topics.FILTER_PARAMETERS)[0].data
    assert len(late.messages(topics.TRUTH_LANDMARKS)[0].landmarks) == 9
    assert len(late.messages(topics.PATH)[0].poses) == STEPS
    assert not filtering.problems and not simulating.problems


def test_names_are_relative(ros: Ros, scene: Path) -> None:
    """In a namespace everything works as without, and nothing leaves it."""
    own = topics.UE_STATE._replace(name="car7/ue_state")
    other = topics.UE_STATE._replace(name="car8/ue_state")
    listener = ros.listen(own, other)
    first, second = (ros.start(FilterNode, name) for name in ("car7", "car8"))
    ros.spin_until(lambda: first.count_subscribers("ue_state") == 1)
    ros.spin_until(lambda: second.count_subscribers("ue_state") == 1)
    ros.start(SimulatorNode, "car7", scenario=str(scene), rate=100.0)
    ros.spin_until(lambda: listener.count(own) == STEPS)
    assert listener.count(other) == 0


def test_rate_may_change_while_running(ros: Ros, scene: Path) -> None:
    """A simulator set to a crawl can be sped up, and loses no snapshot over that."""
    from rclpy.parameter import Parameter

    listener = ros.listen(topics.CHANNEL_MEASUREMENTS, topics.ODOMETRY_CONTROL)
    simulating = ros.start(SimulatorNode, scenario=str(scene), rate=2.0, wait_for_nodes="listener")
    ros.spin_until(lambda: listener.count(topics.CHANNEL_MEASUREMENTS) == 1)
    (result,) = simulating.set_parameters([Parameter("rate", value=200.0)])
    assert result.successful
    ros.spin_until(simulating.finished, timeout=1.5)
    ros.spin_until(lambda: listener.count(topics.CHANNEL_MEASUREMENTS) == STEPS)
    stamps = [stamp_ns(m.header) for m in listener.messages(topics.CHANNEL_MEASUREMENTS)]
    assert np.array_equal(np.diff(stamps), np.full(STEPS - 1, 500_000_000))


def test_the_seed_makes_the_run(ros: Ros, scene: Path, live: LiveRun) -> None:
    """Another seed gives other measurements; the live run's are those of the seed alone."""
    listener = ros.listen(topics.CHANNEL_MEASUREMENTS, topics.ODOMETRY_CONTROL)
    ros.start(
        SimulatorNode,
        scenario=str(scene),
        seed=6,
        rate=100.0,
        start_time=1.0,
        wait_for_nodes="listener",
        base_frame="m",
    )
    ros.spin_until(lambda: listener.count(topics.CHANNEL_MEASUREMENTS) == STEPS)
    ours = listener.bytes(topics.CHANNEL_MEASUREMENTS)
    theirs = live.heard[topics.CHANNEL_MEASUREMENTS.name]
    assert all(a != b for a, b in zip(ours, theirs, strict=True))


def test_diagnostics_tell_how_the_filter_is(live: LiveRun) -> None:
    """The filter's status names what it did and how sound its covariance is."""
    statuses = [s for m in live.messages(topics.DIAGNOSTICS) for s in m.status]
    last = [s for s in statuses if s.name == "/filter"][-1]
    values = {v.key: v.value for v in last.values}
    assert last.level == 0
    assert values["sets_processed"] == str(STEPS)
    assert values["sets_waiting"] == "0"
    assert float(values["smallest_eigenvalue"]) > 0.0
    assert 0.0 < float(values["step_ms_median"]) <= float(values["step_ms_max"])
    assert {s.name for s in statuses} >= {"/simulator", "/filter", "/bounds"}
