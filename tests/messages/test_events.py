"""Events in bags: hostile ones, and those that a replay must not repeat."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dopslam_ros.bag import BagReader, BagWriter, message_class, serialize
from dopslam_ros.core.pmb import FilterParameters
from dopslam_ros.core.session.checkpoint import BEFORE_ALL
from dopslam_ros.core.session.checkpoint_file import to_bytes
from dopslam_ros.core.session.events import Event
from dopslam_ros.core.session.filtering import FilterSession
from dopslam_ros.messages import topics
from dopslam_ros.messages.common import InvalidMessage
from dopslam_ros.messages.events import make_event, read_event, recorded_events
from dopslam_ros.offline.replay import replay

EVENTS, SETS = topics.FILTER_EVENTS, topics.CHANNEL_MEASUREMENTS


def bag_with(simulated: Path, out: Path, events: list[Any], *, skip: int = 0) -> Path:
    """The simulated bag, less its first inputs, with events in front."""
    reader = BagReader(simulated)
    with BagWriter(out, flush_seconds=None) as writer:
        writer.add_topic(f"/{EVENTS.name}", EVENTS.type_name, qos=[EVENTS.qos])
        for message in events:
            writer.write(f"/{EVENTS.name}", serialize(message, EVENTS.type_name), 1)
        left: Counter[str] = Counter()
        for topic, info in reader.topics.items():
            writer.copy_topic(topic, info)
        for m in reader.messages():
            left[m.topic] += 1
            if m.topic not in (f"/{SETS.name}", "/odometry_control") or left[m.topic] > skip:
                writer.write(m.topic, m.payload, m.log_time_ns)
    return out


def test_events_come_back() -> None:
    filtering = FilterSession(FilterParameters())
    for event in (
        filtering.reset(),
        filtering.replace_map(filtering.known_map()),
        Event("continue", 5 * 10**9 + 7, 6 * 10**9),
        Event("resume", BEFORE_ALL, saved=filtering.snapshot()),
    ):
        again = read_event(make_event(message_class, event))
        assert (again.kind, again.after_ns, again.until_ns) == (
            event.kind,
            event.after_ns,
            event.until_ns,
        )
        assert (again.saved is None) == (event.saved is None)
        if event.saved is not None and again.saved is not None:
            assert to_bytes(again.saved) == to_bytes(event.saved)
    with pytest.raises(InvalidMessage, match="explode"):
        read_event(make_event(message_class, Event("explode", 1)))


def test_events_of_no_use_are_counted_and_the_rest_is_replayed(
    simulated: Path, tmp_path: Path
) -> None:
    good = make_event(message_class, Event("reset", 2 * 10**9))
    damaged = make_event(message_class, Event("load_map", BEFORE_ALL))
    damaged.file = np.frombuffer(b"DOPSTATE and then nothing of sense", np.uint8)
    unknown = make_event(message_class, Event("explode", 1))
    other = FilterSession(FilterParameters(bs_position=(1.0, 2.0, 3.0))).known_map()
    foreign = make_event(message_class, Event("load_map", BEFORE_ALL, saved=other))
    plain = replay(BagReader(simulated))
    bag = bag_with(simulated, tmp_path / "bag", [damaged, unknown, foreign, good])
    run = replay(BagReader(bag))
    assert run.problems["event_refused"] == 3
    assert len(run.outputs) == len(plain.outputs)
    same = [
        np.array_equal(one.state.ue_mean, other.state.ue_mean)
        for one, other in zip(run.outputs, plain.outputs, strict=True)
    ]
    assert same[:3] == [True] * 3 and not any(same[4:]), "reset after the set of 2 s"


def test_a_restart_inside_a_bag_is_not_repeated_but_one_before_it_is(
    simulated: Path, tmp_path: Path
) -> None:
    """The bag has the history, so the replay is there by itself; without it, it goes on."""
    plain = replay(BagReader(simulated))
    filtering = FilterSession(plain.parameters)
    for output, record in zip(plain.outputs[:3], plain.outputs[:3], strict=True):
        list(filtering.add_control(output.stamp_ns, *record.control))
        list(filtering.add_measurements(output.stamp_ns, record.measurements))
    event = make_event(message_class, Event("resume", BEFORE_ALL, saved=filtering.snapshot()))
    whole = bag_with(simulated, tmp_path / "whole", [event])
    assert recorded_events(BagReader(whole), "/", Counter()) == []
    rest = bag_with(simulated, tmp_path / "rest", [event], skip=3)
    for bag, wanted in ((whole, plain.outputs), (rest, plain.outputs[3:])):
        run = replay(BagReader(bag))
        assert not run.problems
        assert [o.state.ue_mean.tobytes() for o in run.outputs] == [
            o.state.ue_mean.tobytes() for o in wanted
        ]
