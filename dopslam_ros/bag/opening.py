"""Opening an MCAP file: by its summary when that is sound, else by looking at all of it."""

from __future__ import annotations

import zlib
from collections import Counter
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

from mcap.reader import FOOTER_SIZE, SeekingReader
from mcap.records import Footer
from mcap.stream_reader import MAGIC_SIZE, StreamReader
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC

from dopslam_ros.bag.chunks import DAMAGE, read_part
from dopslam_ros.bag.contents import Block, Contents, Kind
from dopslam_ros.bag.errors import BagFormatError
from dopslam_ros.bag.salvage import Scan

_END_BYTES = FOOTER_SIZE + MAGIC_SIZE


def read_contents(path: Path) -> Contents:
    """Find out what is in a file.

    Args:
        path: An MCAP file; it may be cut off or damaged.

    Raises:
        BagFormatError: It is empty or no MCAP file.
        OSError: It cannot be read.
    """
    with path.open("rb") as stream:
        _check_magic(path, stream.read(MAGIC_SIZE))
        size = stream.seek(0, 2)
        try:
            summary = _summary(stream, size)
        except DAMAGE:
            return Scan(path, stream, size, summary_is_sound=False).run()
        if summary is None or not _is_complete(summary):
            return Scan(path, stream, size, summary_is_sound=True).run()
        return _from_summary(path, summary)


def _check_magic(path: Path, magic: bytes) -> None:
    if not magic:
        raise BagFormatError(
            f"'{path}' is empty (0 bytes): nothing was recorded, or the disk was full"
        )
    if magic != MCAP0_MAGIC:
        raise BagFormatError(
            f"'{path}' is no MCAP file: it starts with {magic!r}; give the folder of a bag or a "
            "file ending in .mcap"
        )


def _summary(stream: BinaryIO, size: int) -> Summary | None:
    """The summary at the end of a file, its checksum compared; None: there is none.

    Raises one of ``DAMAGE`` when the end of the file is missing or damaged.
    """
    end = read_part(stream, max(size - _END_BYTES, 0), _END_BYTES)
    footer = next(StreamReader(BytesIO(end), skip_magic=True).records)
    if not isinstance(footer, Footer):
        raise ValueError("the footer is missing")
    if footer.summary_start == 0:
        return None
    # The checksum is that of everything before it, and the last number of the footer.
    checked = size - MAGIC_SIZE - 4 - footer.summary_start
    content = read_part(stream, footer.summary_start, checked)
    if footer.summary_crc not in (0, zlib.crc32(content)):
        raise ValueError("a summary with a wrong checksum")
    stream.seek(0)
    return SeekingReader(stream, record_size_limit=size).get_summary()


def _is_complete(summary: Summary) -> bool:
    """Whether a summary tells where every message is and what it is."""
    statistics, indexes = summary.statistics, summary.chunk_indexes
    if statistics is None:
        return False
    counts = statistics.channel_message_counts
    used = set(counts).union(*(index.message_index_offsets for index in indexes))
    return (
        len(indexes) == statistics.chunk_count
        and (bool(indexes) or statistics.message_count == 0)
        and sum(counts.values()) == statistics.message_count
        and used <= summary.channels.keys()
        and all(c.schema_id in {0, *summary.schemas} for c in summary.channels.values())
    )


def _from_summary(path: Path, summary: Summary) -> Contents:
    blocks = [
        Block(
            Kind.CHUNK,
            index.chunk_start_offset,
            index.chunk_length,
            index.message_start_time,
            index.message_end_time,
            set(index.message_index_offsets),
        )
        for index in summary.chunk_indexes
    ]
    blocks.sort(key=lambda block: block.offset)
    statistics = summary.statistics
    counts = Counter(statistics.channel_message_counts if statistics else {})
    return Contents(path, summary.schemas, summary.channels, blocks, counts)
