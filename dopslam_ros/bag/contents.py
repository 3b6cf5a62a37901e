"""What is in one MCAP file: by its index when that is sound, else by looking at all of it."""

from __future__ import annotations

import struct
import zlib
from collections import Counter
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import BinaryIO, NamedTuple

from dopslam_ros.bag import records
from dopslam_ros.bag.errors import BagFormatError
from dopslam_ros.bag.records import Channel, Cursor, DamagedError, Record, Schema

_FOOTER_BYTES = 29
_TAIL_BYTES = _FOOTER_BYTES + len(records.MAGIC)
_PLAIN_BLOCK_BYTES = 2**20


class Kind(Enum):
    """How the messages of a block are stored."""

    CHUNK = "in a chunk"
    CUT_CHUNK = "in a chunk whose end is missing"
    PLAIN = "as records of the file"


class Block(NamedTuple):
    """A part of a file that is read at once.

    Attributes:
        start_ns: Earliest log time in it [ns].
        end_ns: Latest log time in it [ns].
        offset: Where it is in the file [bytes].
        length: How long it is [bytes].
        kind: How its messages are stored.
        channels: Numbers of the channels in it; None: not known.
    """

    start_ns: int
    end_ns: int
    offset: int
    length: int
    kind: Kind
    channels: frozenset[int] | None


@dataclass
class Contents:
    """What is in a file.

    Attributes:
        path: The file.
        schemas: Message types by number.
        channels: Topics by number.
        blocks: Where the messages are, in the order of the file.
        counts: Number of messages by channel.
        problems: What is wrong with the file, in parts of a sentence.
    """

    path: Path
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    blocks: list[Block] = field(default_factory=list)
    counts: Counter[int] = field(default_factory=Counter)
    problems: list[str] = field(default_factory=list)

    def declare(self, data: bytes, record: Record) -> None:
        """Note the type or topic that a record declares; other records are ignored."""
        cursor = Cursor(data, record.start, record.end)
        if record.opcode == records.SCHEMA:
            schema = records.parse_schema(cursor)
            self.schemas.setdefault(schema.number, schema)
        elif record.opcode == records.CHANNEL:
            channel = records.parse_channel(cursor)
            self.channels.setdefault(channel.number, channel)

    def type_name(self, channel: Channel) -> str:
        """Type of a channel's messages; empty when it has none."""
        schema = self.schemas.get(channel.schema)
        return "" if schema is None else schema.name


def read_contents(path: Path) -> Contents:
    """Find out what is in a file.

    Args:
        path: An MCAP file; it may be cut off or damaged.

    Raises:
        BagFormatError: It is empty or no MCAP file.
        OSError: It cannot be read.
    """
    with path.open("rb") as stream:
        _check_magic(path, stream.read(len(records.MAGIC)))
        size = stream.seek(0, 2)
        try:
            contents = _from_index(path, stream, size)
            return contents or _Scan(path, stream, size, index_is_sound=True).run()
        except (DamagedError, struct.error):
            return _Scan(path, stream, size, index_is_sound=False).run()


def load_block(stream: BinaryIO, block: Block) -> bytes:
    """Read the records of a block.

    Raises:
        DamagedError: They are damaged.
    """
    data = records.read_at(stream, block.offset, block.length)
    if block.kind is Kind.PLAIN:
        return data
    opcode, length = records.RECORD_HEADER.unpack_from(data)
    cursor = Cursor(data, records.RECORD_HEADER.size)
    if opcode != records.CHUNK:
        raise DamagedError(f"a record with opcode {opcode} in the place of a chunk")
    if block.kind is Kind.CUT_CHUNK:
        return records.salvage_chunk(cursor)
    if length != cursor.remaining:
        raise DamagedError(f"a chunk of {length} bytes that should have {cursor.remaining}")
    return records.unpack_chunk(cursor)


def _check_magic(path: Path, magic: bytes) -> None:
    if not magic:
        raise BagFormatError(
            f"'{path}' is empty (0 bytes): nothing was recorded, or the disk was full"
        )
    if magic != records.MAGIC:
        raise BagFormatError(
            f"'{path}' is no MCAP file: it starts with {magic!r}; give the folder of a bag or a "
            "file ending in .mcap"
        )


def _from_index(path: Path, stream: BinaryIO, size: int) -> Contents | None:
    """Read the summary at the end of a file.

    Returns:
        None when there is none, or too little in it.

    Raises:
        DamagedError: The end of the file is missing or damaged.
    """
    footer = _footer(stream, size)
    if footer.summary_start == 0:
        return None
    length = size - _TAIL_BYTES - footer.summary_start
    if length < 0:
        raise DamagedError(f"a summary at byte {footer.summary_start} of a file of {size} bytes")
    summary = records.read_at(stream, footer.summary_start, length + _FOOTER_BYTES - 4)
    if footer.summary_crc and zlib.crc32(summary) != footer.summary_crc:
        raise DamagedError("a summary with a wrong checksum")
    return _from_summary(path, summary[:length], footer.summary_start)


def _footer(stream: BinaryIO, size: int) -> records.Footer:
    if size < _TAIL_BYTES + len(records.MAGIC):
        raise DamagedError("the end is missing")
    tail = records.read_at(stream, size - _TAIL_BYTES, _TAIL_BYTES)
    if records.RECORD_HEADER.unpack_from(tail) != (records.FOOTER, _FOOTER_BYTES - 9):
        raise DamagedError("the footer is missing")
    if tail[_FOOTER_BYTES:] != records.MAGIC:
        raise DamagedError("the last bytes are not those of an MCAP file")
    return records.parse_footer(Cursor(tail, records.RECORD_HEADER.size))


def _from_summary(path: Path, summary: bytes, data_end: int) -> Contents | None:
    contents = Contents(path)
    statistics: records.Statistics | None = None
    for record in records.records(summary):
        cursor = Cursor(summary, record.start, record.end)
        contents.declare(summary, record)
        if record.opcode == records.STATISTICS:
            statistics = records.parse_statistics(cursor)
        elif record.opcode == records.CHUNK_INDEX:
            index = records.parse_chunk_index(cursor)
            if index.offset + index.length > data_end or index.length < 9:
                raise DamagedError(f"a chunk at byte {index.offset} of the {data_end} there are")
            contents.blocks.append(Block(*index[:4], Kind.CHUNK, index.channels))
    if statistics is None or not _is_complete(contents, statistics):
        return None
    contents.counts.update(statistics.counts)
    contents.blocks.sort(key=lambda block: block.offset)
    return contents


def _is_complete(contents: Contents, statistics: records.Statistics) -> bool:
    """Whether the summary tells where every message is and what it is."""
    used = frozenset(statistics.counts).union(*(b.channels or () for b in contents.blocks))
    return (
        len(contents.blocks) == statistics.chunk_count
        and (statistics.chunk_count > 0 or statistics.message_count == 0)
        and sum(statistics.counts.values()) == statistics.message_count
        and all(number in contents.channels for number in used)
        and all(c.schema in {0, *contents.schemas} for c in contents.channels.values())
    )


class _Scan:
    """Looks at every record of a file and remembers what it finds."""

    def __init__(self, path: Path, stream: BinaryIO, size: int, *, index_is_sound: bool) -> None:
        self._index_is_sound = index_is_sound
        self._chunked = False
        self._contents = Contents(path)
        self._stream = stream
        self._size = size
        self._position = len(records.MAGIC)
        self._data_ended = False
        self._broken_chunks = 0

    def run(self) -> Contents:
        """Look at everything up to the end or the first record that cannot be followed."""
        while self._step():
            pass
        self._note_problems()
        return self._contents

    def _step(self) -> bool:
        """Look at one record; return whether another one may follow."""
        header = records.RECORD_HEADER
        if self._position + header.size > self._size:
            return False
        self._stream.seek(self._position)
        opcode, length = header.unpack(self._stream.read(header.size))
        left = self._size - self._position - header.size
        if opcode == records.NOTHING:
            return False
        if length > left:
            self._cut_record(opcode, header.size + left)
            return False
        self._whole_record(opcode, header.size + length)
        self._position += header.size + length
        return bool(opcode != records.FOOTER)

    @property
    def _believes_declarations(self) -> bool:
        """Whether types and topics outside the chunks are taken as they stand.

        Files with chunks declare them in there, under a checksum; those beside are repeated in the
        summary, and when its checksum is wrong a name in it may be too.
        """
        return self._index_is_sound or not self._chunked

    def _whole_record(self, opcode: int, length: int) -> None:
        try:
            if opcode == records.CHUNK:
                self._chunked = True
                self._add_chunk(Kind.CHUNK, length)
            elif opcode == records.MESSAGE:
                self._add_plain_message(length)
            elif opcode in (records.SCHEMA, records.CHANNEL) and self._believes_declarations:
                data = records.read_at(self._stream, self._position, length)
                self._contents.declare(data, Record(opcode, records.RECORD_HEADER.size, length))
            elif opcode == records.DATA_END:
                self._data_ended = True
        except DamagedError:
            self._broken_chunks += opcode == records.CHUNK

    def _cut_record(self, opcode: int, length: int) -> None:
        """Get what there is of the chunk that the end of the file cuts."""
        if opcode == records.CHUNK:
            try:
                self._add_chunk(Kind.CUT_CHUNK, length)
            except DamagedError:
                pass

    def _add_chunk(self, kind: Kind, length: int) -> None:
        block = Block(0, 0, self._position, length, kind, None)
        data = load_block(self._stream, block)
        found = list(records.records(data, cut=kind is Kind.CUT_CHUNK))
        messages = [records.message_header(data, r) for r in found if r.opcode == records.MESSAGE]
        for record in found:
            self._contents.declare(data, record)
        if messages:
            self._contents.counts.update(channel for channel, _, _ in messages)
            times = [log_ns for _, log_ns, _ in messages]
            channels = frozenset(channel for channel, _, _ in messages)
            span = Block(min(times), max(times), self._position, length, kind, channels)
            self._contents.blocks.append(span)

    def _add_plain_message(self, length: int) -> None:
        """Add a message outside a chunk to the block before it, or start a block with it."""
        blocks = self._contents.blocks
        if blocks and blocks[-1].kind is not Kind.PLAIN:
            raise DamagedError("a message outside the chunks")
        header = records.RECORD_HEADER.size
        data = records.read_at(
            self._stream, self._position, min(length, header + records.MESSAGE_HEADER.size)
        )
        channel, log_ns, _ = records.message_header(data, Record(0, header, len(data)))
        self._contents.counts[channel] += 1
        single = Block(log_ns, log_ns, self._position, length, Kind.PLAIN, frozenset({channel}))
        if blocks and _adjoin(blocks[-1], single):
            blocks[-1] = _join(blocks[-1], single)
        else:
            blocks.append(single)

    def _note_problems(self) -> None:
        counts, channels = self._contents.counts, self._contents.channels
        unknown = sum(count for number, count in counts.items() if number not in channels)
        name, total = f"'{self._contents.path}'", sum(counts.values()) - unknown
        if not self._data_ended:
            unread = self._size - self._position
            self._contents.problems.append(
                f"{name} breaks off after {total} messages without its index, with {unread} bytes "
                "that cannot be read (it was cut off, probably by a kill or a full disk, or is "
                "still being recorded)"
            )
        elif not self._index_is_sound:
            self._contents.problems.append(
                f"the index of {name} is missing or damaged ({total} messages were found "
                "without it)"
            )
        if self._broken_chunks:
            self._contents.problems.append(
                f"{self._broken_chunks} damaged chunk(s) of {name} are left out"
            )
        if unknown:
            self._contents.problems.append(
                f"{unknown} messages of {name} are left out because the record of their topic is "
                "lost"
            )
        for number in counts.keys() - channels.keys():
            del counts[number]


def _adjoin(block: Block, single: Block) -> bool:
    return (
        block.offset + block.length == single.offset
        and block.length + single.length <= _PLAIN_BLOCK_BYTES
    )


def _join(block: Block, single: Block) -> Block:
    return Block(
        min(block.start_ns, single.start_ns),
        max(block.end_ns, single.end_ns),
        block.offset,
        block.length + single.length,
        Kind.PLAIN,
        (block.channels or frozenset()) | (single.channels or frozenset()),
    )
