"""A recorded run beside its replay, byte for byte."""

from __future__ import annotations

from pathlib import Path

from dopslam_ros.bag import BagReader, BagWriter
from dopslam_ros.messages import topics
from dopslam_ros.offline.replay import replay
from dopslam_ros.offline.replay_result import Replay


def replay_and_compare(bag: Path, out: Path) -> tuple[Replay, str | None]:
    """Replays a bag offline and holds the result against what was recorded live.

    Returns:
        The replay, and None if the streams of vehicle states are equal byte for byte, else what
        differs.
    """
    reader = BagReader(bag)
    with BagWriter(out, flush_seconds=None) as writer:
        run = replay(reader, writer=writer)
    return run, difference(reader, BagReader(out), "/" + topics.UE_STATE.name)


def difference(live: BagReader, again: BagReader, topic: str) -> str | None:
    """What differs between two recordings of a topic, or None if all their bytes are equal."""
    first = [message.payload for message in live.messages({topic})]
    second = [message.payload for message in again.messages({topic})]
    if len(first) != len(second):
        return f"{len(first)} messages on {topic} live, {len(second)} in the replay"
    unequal = [n for n, (a, b) in enumerate(zip(first, second, strict=True)) if a != b]
    if unequal:
        return f"{len(unequal)} of {len(first)} messages on {topic} differ, first: {unequal[0]}"
    return None
