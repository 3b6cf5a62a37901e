"""A simulated run written straight into a bag: the same as the simulator node's."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import yaml

from dopslam_ros.bag import BagReader, BagWriter, deserialize
from dopslam_ros.messages import topics
from dopslam_ros.messages.common import stamp_ns
from dopslam_ros.messages.inputs import read_control, read_measurements
from dopslam_ros.messages.states import read_ue_state
from dopslam_ros.offline.replay import replay
from dopslam_ros.simulation.recording import write_simulation
from dopslam_ros.simulation.scenario import load_scenario
from dopslam_ros.simulation.simulator import simulate

if TYPE_CHECKING:
    from tests.conftest import LiveRun

STEPS, SEED = 8, 5
Payloads = Callable[..., list[bytes]]


def test_the_bag_holds_the_run(simulated: Path, scene: Path, bag_payloads: Payloads) -> None:
    """Truth, controls and sets in the bag are those that the core simulates for the seed."""
    snapshots = list(simulate(load_scenario(scene), np.random.default_rng(SEED)))
    columns = [
        [deserialize(p, t.type_name) for p in bag_payloads(simulated, t)]
        for t in (topics.TRUTH_UE, topics.ODOMETRY_CONTROL, topics.CHANNEL_MEASUREMENTS)
    ]
    assert len(snapshots) == STEPS
    for snapshot, state, control, paths in zip(snapshots, *columns, strict=True):
        assert all(stamp_ns(m.header) == snapshot.stamp_ns for m in (state, control, paths))
        assert np.array_equal(read_ue_state(state)[0], snapshot.state)
        assert read_control(control) == snapshot.control
        values = read_measurements(paths).values
        assert np.array_equal(values, snapshot.measurements.values, equal_nan=True)


def test_the_bag_is_that_of_the_node(
    live: LiveRun, scene: Path, simulated: Path, bag_payloads: Payloads
) -> None:
    """With the same seed and start the live simulator sent the same, but for the frames' names."""
    for topic, read in (
        (topics.CHANNEL_MEASUREMENTS, lambda m: read_measurements(m).values.tobytes()),
        (topics.TRUTH_UE, lambda m: read_ue_state(m)[0].tobytes()),
        (topics.ODOMETRY_CONTROL, read_control),
    ):
        ours = [deserialize(p, topic.type_name) for p in bag_payloads(simulated, topic)]
        theirs = live.messages(topic)
        assert [stamp_ns(m.header) for m in ours] == [stamp_ns(m.header) for m in theirs]
        assert [read(m) for m in ours] == [read(m) for m in theirs]


def test_the_models_are_in_the_bag(tmp_path: Path, bag_payloads: Payloads) -> None:
    """A replay is set to the scene that was simulated, not to the defaults."""
    file = tmp_path / "scene.yaml"
    change = {"clutter_mean": 0.25, "measurement_noise_std": [0.2, 0.1, 0.1, 0.1, 0.1, 0.3]}
    controls = [{"steps": 3, "speed": 5.0, "turn_rate": 0.0}]
    file.write_text(yaml.safe_dump({"base": "paper", "controls": controls, **change}), "utf-8")
    with BagWriter(tmp_path / "bag", flush_seconds=None) as writer:
        assert write_simulation(load_scenario(file), 1, writer) == 3
    run = replay(BagReader(tmp_path / "bag"))
    assert run.parameters.clutter_mean == 0.25
    assert list(run.parameters.measurement_noise_std) == change["measurement_noise_std"]
    assert len(run.outputs) == 3 and not run.problems


def test_a_receiver_without_doppler(tmp_path: Path, bag_payloads: Payloads) -> None:
    """A component that the scene does not measure is NaN in every path, and the filter copes."""
    file = tmp_path / "scene.yaml"
    text = (
        "base: paper\ncontrols: [{steps: 4, speed: 5.0, turn_rate: 0.0}]\n"
        "measurement_noise_std: [0.1, 0.05, .nan, 0.05, 0.05, .nan]\n"
    )
    file.write_text(text, "utf-8")
    with BagWriter(tmp_path / "bag", flush_seconds=None) as writer:
        write_simulation(load_scenario(file), 1, writer)
    topic = topics.CHANNEL_MEASUREMENTS
    for payload in bag_payloads(tmp_path / "bag", topic):
        values = read_measurements(deserialize(payload, topic.type_name)).values
        assert np.isnan(values[:, [2, 5]]).all()
        assert np.isfinite(values[:, [0, 1, 3, 4]]).all()
    run = replay(BagReader(tmp_path / "bag"))
    assert len(run.outputs) == 4 and not run.problems
    errors = np.array([record.error for record in run.records()])
    assert np.hypot(errors[:, 0], errors[:, 1]).max() < 3.0


def test_latched_topics_are_marked(simulated: Path) -> None:
    """The bag says of each topic how the simulator offers it."""
    found = BagReader(simulated).topics
    for topic in (*topics.INPUTS, topics.FILTER_PARAMETERS):
        assert found["/" + topic.name].qos == (topic.qos,)
