"""The filter for two hours of a scene: does memory stay, does a step take as long as ever?"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np

from dopslam_ros.bag import BagReader, BagWriter, message_class, serialize
from dopslam_ros.core.session.filtering import FilterSession
from dopslam_ros.core.settings.layout import VEHICLE
from dopslam_ros.lab.bench.batch import in_a_child, occupied
from dopslam_ros.lab.bench.records import Measured, Ratio, figure, milliseconds
from dopslam_ros.messages import topics
from dopslam_ros.messages.common import Frames, read_message, stamp_ns
from dopslam_ros.messages.filter_output import FilterMessages
from dopslam_ros.messages.inputs import read_control, read_measurements
from dopslam_ros.simulation.matched import filter_parameters_for
from dopslam_ros.simulation.recording import snapshot_messages
from dopslam_ros.simulation.scenario import Scenario, load_scenario
from dopslam_ros.simulation.simulator import simulate
from dopslam_ros.system.stopping import Stop, until_stopped

RATE = 10.0
SECONDS, QUICK_SECONDS = 7200.0, 60.0
PARTS = 10
READ = (topics.ODOMETRY_CONTROL, topics.CHANNEL_MEASUREMENTS)


class Soaked(NamedTuple):
    """What became of a long run.

    Attributes:
        digest: of every message that the filter would have published.
        seconds: median time of a set from its bytes to those of the answers, by tenth of the run.
        occupied: bytes that the process occupied after each tenth.
    """

    digest: str
    seconds: list[float]
    occupied: list[int]


def soak(quick: bool) -> Measured:
    """Records the inputs, filters them in one process and, for the same results, in another.

    Raises:
        RuntimeError: the two did not say the same.
    """
    steps = round(RATE * (QUICK_SECONDS if quick else SECONDS))
    with TemporaryDirectory() as folder:
        bag = Path(folder) / "inputs"
        record_inputs(bag, steps)
        first = in_a_child(soaked, bag, steps)
        again = in_a_child(soaked, bag, steps)
    if first.digest != again.digest:
        raise RuntimeError(f"{steps} sets filtered again gave other results")
    early, late = (
        milliseconds(f"set, {part} tenth", [first.seconds[n]])
        for part, n in (("second", 1), ("last", -1))
    )
    memory = [
        figure(f"memory after the {part} tenth", "MB", [first.occupied[n] / 2**20])
        for part, n in (("first", 0), ("last", -1))
    ]
    return Measured(
        (early, late, *memory),
        (
            Ratio("time of a set, last / second tenth", late.median / early.median),
            Ratio("memory, after the last / the first tenth", memory[1].median / memory[0].median),
        ),
        (f"{steps:,} sets at {RATE:g} Hz; all answers equal, byte for byte, in another process",),
    )


def endless_scene(rate: float, steps: int) -> Scenario:
    """The paper's scene in quick succession; without noise the vehicle stays on its circle."""
    paper = load_scenario("paper")
    controls = paper.controls[:1] * steps
    return replace(
        paper, period=1.0 / rate, controls=controls, process_noise_std=(0.0,) * len(VEHICLE)
    )


def record_inputs(bag: Path, steps: int) -> None:
    """Writes a bag of what a filter hears, set by set.

    Raises:
        BagError: it cannot be written.
    """
    scene = endless_scene(RATE, steps)
    with Stop(), BagWriter(bag, chunk_bytes=2**20, flush_seconds=None) as writer:
        for snapshot in until_stopped(simulate(scene, np.random.default_rng(1))):
            for topic, message in snapshot_messages(snapshot, snapshot.stamp_ns, Frames()):
                name = "/" + topic.name
                writer.add_topic(name, topic.type_name, qos=[topic.qos])
                writer.write(name, serialize(message, topic.type_name), snapshot.stamp_ns)


def answers(bag: Path) -> Iterator[list[tuple[topics.Topic, bytes]]]:
    """What the filter says to each message of a bag, as it would be published.

    Raises:
        BagError: the bag cannot be read.
        RuntimeError: the filter had problems.
    """
    parameters = filter_parameters_for(load_scenario("paper"))
    session = FilterSession(parameters)
    messages = FilterMessages(message_class, parameters.bs, parameters.ue_height)
    names = {"/" + topic.name: topic for topic in READ}
    for recorded in BagReader(bag).messages(set(names)):
        topic = names[recorded.topic]
        content = read_message(recorded.payload, topic)
        stamp = stamp_ns(content.header)
        if topic == topics.ODOMETRY_CONTROL:
            outputs = session.add_control(stamp, *read_control(content))
        else:
            outputs = session.add_measurements(stamp, read_measurements(content))
        yield [
            (of, serialize(message, of.type_name))
            for output in outputs
            for of, message in messages.of(output)
        ]
    if session.problems:
        raise RuntimeError(f"the filter had problems: {dict(session.problems)}")


def soaked(bag: Path, steps: int) -> Soaked:
    """Filters a bag of so many sets in this process."""
    total = hashlib.sha256()
    seconds: list[float] = []
    memory: list[int] = []
    medians: list[float] = []
    spent, before = 0.0, time.perf_counter()
    for said in answers(bag):
        spent += time.perf_counter() - before
        for topic, payload in said:
            total.update(topic.name.encode())
            total.update(payload)
        if said:
            seconds.append(spent)
            spent = 0.0
            if len(seconds) == steps // PARTS:
                medians.append(float(np.median(seconds)))
                memory.append(occupied())
                seconds.clear()
        before = time.perf_counter()
    return Soaked(total.hexdigest(), medians, memory)
