"""Saving what can be read of a damaged bag: ``dopslam recover OLD [NEW]``."""

from __future__ import annotations

from itertools import count
from pathlib import Path

from dopslam_ros.bag.reader import BagReader
from dopslam_ros.bag.writer import BagWriter


def free_name(source: Path) -> Path:
    """A name for what is saved of a bag, beside it, that nothing has: ``bag_recovered``."""
    source = Path(source).absolute()
    stem = source.stem if source.suffix == ".mcap" else source.name
    names = (f"{stem}_recovered" + (f"_{number}" if number else "") for number in count())
    return next(p for p in map(source.with_name, names) if not (p.exists() or p.is_symlink()))


def repair(source: Path, target: Path) -> BagReader:
    """Write every message of a bag that can be read to a new, whole bag.

    Args:
        source: Folder of a bag or an MCAP file, damaged or not; stays as it is.
        target: Folder of the new bag; must not exist.

    Returns:
        The reader, which knows how many messages there were and what is missing.

    Raises:
        BagFormatError: There is nothing to read at ``source``.
        BagExistsError: ``target`` exists.
        BagError: The disk refused.
    """
    reader = BagReader(source)
    with BagWriter(target, chunk_bytes=2**20, flush_seconds=None) as writer:
        for topic, info in reader.topics.items():
            writer.copy_topic(topic, info)
        for message in reader.messages():
            writer.write(
                message.topic, message.payload, message.log_time_ns, message.publish_time_ns
            )
    return reader
