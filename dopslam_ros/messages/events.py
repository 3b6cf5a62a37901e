"""Events of the filter as messages, with the file that was loaded inside."""

from __future__ import annotations

import contextlib
from collections import Counter
from typing import Any

import numpy as np

from dopslam_ros.bag import BagReader
from dopslam_ros.core.session.checkpoint import BEFORE_ALL, CheckpointError
from dopslam_ros.core.session.checkpoint_file import decode, to_bytes
from dopslam_ros.core.session.events import KINDS, RESUME, Event
from dopslam_ros.messages import topics
from dopslam_ros.messages.common import InvalidMessage, Types, make_time, read_message


def make_event(types: Types, event: Event) -> Any:
    """A dopslam_msgs/FilterEvent."""
    file = b"" if event.saved is None else to_bytes(event.saved)
    return types(topics.FILTER_EVENTS.type_name)(
        kind=event.kind,
        after=make_time(types, max(event.after_ns, 0)),
        until=make_time(types, max(event.until_ns, 0)),
        file=np.frombuffer(file, np.uint8),
    )


def read_event(message: Any) -> Event:
    """Of a dopslam_msgs/FilterEvent.

    Raises:
        InvalidMessage: its kind is unknown.
        CheckpointError: what was loaded cannot be read.
    """
    if message.kind not in KINDS:
        raise InvalidMessage("unknown_event", f"'{message.kind}' is none of {', '.join(KINDS)}")
    file = bytes(message.file)
    after, until = _nanoseconds(message.after), _nanoseconds(message.until)
    saved = decode(file) if file else None
    return Event(message.kind, after or BEFORE_ALL, until, saved)


def recorded_events(reader: BagReader, prefix: str, problems: Counter[str]) -> list[Event]:
    """The events of the filter in a bag that a replay must repeat, in their order.

    Not that a filter went on from a snapshot of a time that the bag has sets of: the replay is
    there by itself.

    Args:
        reader: the bag.
        prefix: the namespace of the filter, with a slash at its end.
        problems: an event that cannot be read is counted here.
    """
    name, sets = prefix + topics.FILTER_EVENTS.name, prefix + topics.CHANNEL_MEASUREMENTS.name
    if name not in reader.topics:
        return []
    events = []
    for message in reader.messages({name}):
        try:
            events.append(read_event(read_message(message.payload, topics.FILTER_EVENTS)))
        except (CheckpointError, InvalidMessage):
            problems["event_refused"] += 1
    if not any(event.kind == RESUME for event in events):
        return events
    begin = _first_stamp(reader, sets)
    return [e for e in events if e.kind != RESUME or e.saved is None or e.saved.stamp_ns < begin]


def _first_stamp(reader: BagReader, name: str) -> int:
    """Of the first message of a topic that can be read [ns], or 0."""
    for message in reader.messages({name}):
        with contextlib.suppress(InvalidMessage):
            content = read_message(message.payload, topics.CHANNEL_MEASUREMENTS)
            return _nanoseconds(content.header.stamp)
    return 0


def _nanoseconds(time: Any) -> int:
    return int(time.sec) * 1_000_000_000 + int(time.nanosec)
