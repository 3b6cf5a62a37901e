"""What is in one MCAP file: by its summary when that is sound, else by looking at all of it.

The format is specified at https://mcap.dev/spec; the library ``mcap`` reads its records. Here is
what it does not do: to doubt what a damaged file claims, and to go on behind the damage.
"""

from __future__ import annotations

import struct
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from enum import Enum
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, NamedTuple

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import FOOTER_SIZE, SeekingReader
from mcap.records import Channel, Chunk, Footer, McapRecord, Message, Schema
from mcap.stream_reader import MAGIC_SIZE, StreamReader, breakup_chunk, get_chunk_data_stream
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC

from dopslam_ros.bag.errors import BagFormatError

_RECORD_HEADER = struct.Struct("<BQ")  # opcode and length of what follows
_MESSAGE_HEADER_BYTES = 22
_MESSAGE_BYTES = _RECORD_HEADER.size + _MESSAGE_HEADER_BYTES
_END_BYTES = FOOTER_SIZE + MAGIC_SIZE
_NOTHING = 0x00  # no record has this opcode: where it is, a file was never written
_PLAIN_BLOCK_BYTES = 2**20
_LIMIT_BYTES = 2**30
# The size that a chunk's data tell; -1: none. Memory is taken for as much as a frame of zstd tells.
_SIZE_TOLD: dict[str, Callable[[bytes], int]] = {
    "": len,
    "zstd": zstandard.frame_content_size,
    "lz4": lambda data: -1,
}

# Whatever mcap and the libraries below it raise at bytes that do not make sense.
_DAMAGE = (
    McapError, ValueError, OverflowError, MemoryError, RuntimeError, struct.error,
    zstandard.ZstdError,
)  # fmt: skip


class DamagedError(Exception):
    """Bytes that do not make sense; stays inside this package."""


class Kind(Enum):
    """How the messages of a block are stored."""

    CHUNK = "in a chunk"
    CUT_CHUNK = "in a chunk whose end is missing"
    PLAIN = "as records of the file"


@dataclass
class Block:
    """A part of a file that is read at once.

    Attributes:
        kind: How its messages are stored.
        offset: Where it is in the file [bytes].
        length: How long it is [bytes].
        start_ns: Earliest log time in it [ns].
        end_ns: Latest log time in it [ns].
        channels: Numbers of the channels in it; empty: not known.
    """

    kind: Kind
    offset: int
    length: int
    start_ns: int
    end_ns: int
    channels: set[int]


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

    def type_name(self, channel: Channel) -> str:
        """Type of a channel's messages; empty when it has none."""
        schema = self.schemas.get(channel.schema_id)
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
        _check_magic(path, stream.read(MAGIC_SIZE))
        size = stream.seek(0, 2)
        try:
            summary = _summary(stream, size)
        except _DAMAGE:
            return _Scan(path, stream, size, summary_is_sound=False).run()
        if summary is None or not _is_complete(summary):
            return _Scan(path, stream, size, summary_is_sound=True).run()
        return _from_summary(path, summary)


def load_block(stream: BinaryIO, block: Block) -> list[McapRecord]:
    """Read the records of a block.

    Raises:
        DamagedError: They are damaged.
    """
    try:
        chunk = _chunk(block.kind, _read(stream, block.offset, block.length))
        return breakup_chunk(chunk, validate_crc=True)
    except _DAMAGE as error:
        raise DamagedError(f"a chunk ({str(error) or type(error).__name__})") from error


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

    Raises one of ``_DAMAGE`` when the end of the file is missing or damaged.
    """
    end = _read(stream, max(size - _END_BYTES, 0), _END_BYTES)
    footer = next(StreamReader(BytesIO(end), skip_magic=True).records)
    if not isinstance(footer, Footer):
        raise ValueError("the footer is missing")
    if footer.summary_start == 0:
        return None
    # The checksum is that of everything before it, and the last number of the footer.
    checked = size - MAGIC_SIZE - 4 - footer.summary_start
    content = _read(stream, footer.summary_start, checked)
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


class _Place(NamedTuple):
    """Where a record is, and whether the end of the file cuts it."""

    opcode: int
    offset: int
    length: int
    is_cut: bool


def _places(stream: BinaryIO, offset: int, size: int) -> Iterator[_Place]:
    """The records from an offset on, up to the first one that cannot be followed."""
    while offset + _RECORD_HEADER.size <= size:
        stream.seek(offset)
        opcode, length = _RECORD_HEADER.unpack(stream.read(_RECORD_HEADER.size))
        if opcode == _NOTHING:
            return
        end = offset + _RECORD_HEADER.size + length
        yield _Place(opcode, offset, min(end, size) - offset, end > size)
        offset = end


def _read(stream: BinaryIO, offset: int, length: int) -> bytes:
    """Part of a file: all of it, or ValueError."""
    if not 0 <= length <= _LIMIT_BYTES:
        raise ValueError(f"a length of {length} bytes")
    stream.seek(offset)
    data = stream.read(length)
    if len(data) != length:
        raise ValueError(f"the file ends {length - len(data)} bytes too early")
    return data


def _content(data: bytes) -> ReadDataStream:
    """What a record contains, for mcap to read: it cannot get beyond the end of ``data``."""
    return ReadDataStream(BytesIO(data[_RECORD_HEADER.size :]))


def _chunk(kind: Kind, data: bytes) -> Chunk:
    """The chunk in the bytes of a block, which is safe to unpack; raises one of ``_DAMAGE``."""
    if kind is Kind.PLAIN:
        return Chunk("", data, 0, 0, 0, len(data))
    if data[:1] != bytes([Opcode.CHUNK]):
        raise ValueError("another record is in its place")
    chunk: Chunk = Chunk.read(_content(data))
    if chunk.compression not in _SIZE_TOLD:
        raise ValueError(f"compression {chunk.compression!r}, known are zstd and lz4")
    if chunk.uncompressed_size > _LIMIT_BYTES:
        raise ValueError(f"a size of {chunk.uncompressed_size} bytes")
    if kind is Kind.CUT_CHUNK:
        return _beginning(chunk)
    told = _SIZE_TOLD[chunk.compression](chunk.data)
    if told not in (-1, chunk.uncompressed_size):
        raise ValueError(f"a size of {told} bytes that should be {chunk.uncompressed_size}")
    return chunk if chunk.uncompressed_crc else _followed(chunk)


def _followed(chunk: Chunk) -> Chunk:
    """A chunk without checksum: mcap takes its last record for whole whatever its length says."""
    stream, size = get_chunk_data_stream(chunk)
    data = stream.read(size)
    end = _end_of_whole_records(data)
    if end != size:
        raise ValueError(f"a record breaks off {size - end} bytes before its end")
    return replace(chunk, compression="", data=data)


def _beginning(chunk: Chunk) -> Chunk:
    """The whole records at the beginning of a chunk whose end is missing."""
    data = chunk.data
    if chunk.compression == "lz4":
        raise ValueError("it breaks off")
    if chunk.compression == "zstd":
        unpacking = zstandard.ZstdDecompressor().stream_reader(data)
        data = unpacking.read(chunk.uncompressed_size)
    # A checksum tells about all of the content only, which may be there though the record is cut.
    crc = chunk.uncompressed_crc if len(data) == chunk.uncompressed_size else 0
    data = data[: _end_of_whole_records(data)]
    return replace(chunk, compression="", data=data, uncompressed_crc=crc)


def _end_of_whole_records(data: bytes) -> int:
    """Up to where the records of a chunk can be followed."""
    end = 0
    for place in _places(BytesIO(data), 0, len(data)):
        if place.is_cut or (place.opcode == Opcode.MESSAGE and place.length < _MESSAGE_BYTES):
            break
        end = place.offset + place.length
    return end


class _Scan:
    """Looks at every record of a file and remembers what it finds."""

    def __init__(self, path: Path, stream: BinaryIO, size: int, *, summary_is_sound: bool) -> None:
        self._contents = Contents(path)
        self._stream = stream
        self._size = size
        self._summary_is_sound = summary_is_sound
        self._chunked = False
        self._data_ended = False
        self._broken_chunks = 0
        self._end = MAGIC_SIZE  # of the last whole record

    def run(self) -> Contents:
        """Look at everything up to the end or the first record that cannot be followed."""
        for place in _places(self._stream, MAGIC_SIZE, self._size):
            try:
                self._look_at(place)
            except (DamagedError, *_DAMAGE):
                self._broken_chunks += place.opcode == Opcode.CHUNK and not place.is_cut
            if not place.is_cut:
                self._end = place.offset + place.length
        self._note_problems()
        return self._contents

    def _look_at(self, place: _Place) -> None:
        if place.opcode == Opcode.CHUNK:
            self._chunked |= not place.is_cut
            self._add_chunk(place)
        elif place.is_cut:
            return
        elif place.opcode == Opcode.MESSAGE and not self._chunked:
            self._add_plain_message(place)
        elif place.opcode == Opcode.SCHEMA and self._believes_declarations:
            self._declare(Schema.read(_content(self._data_of(place))))
        elif place.opcode == Opcode.CHANNEL and self._believes_declarations:
            self._declare(Channel.read(_content(self._data_of(place))))
        elif place.opcode == Opcode.DATA_END:
            self._data_ended = True

    @property
    def _believes_declarations(self) -> bool:
        """Whether types and topics outside the chunks are taken as they stand.

        Files with chunks declare them in there, under a checksum; those beside are repeated in the
        summary, and when its checksum is wrong a name in it may be too.
        """
        return self._summary_is_sound or not self._chunked

    def _data_of(self, place: _Place) -> bytes:
        return _read(self._stream, place.offset, place.length)

    def _declare(self, record: McapRecord) -> None:
        """Note the type or topic that a record declares; other records are ignored."""
        if isinstance(record, Schema):
            self._contents.schemas.setdefault(record.id, record)
        elif isinstance(record, Channel):
            self._contents.channels.setdefault(record.id, record)

    def _add_chunk(self, place: _Place) -> None:
        kind = Kind.CUT_CHUNK if place.is_cut else Kind.CHUNK
        block = Block(kind, place.offset, place.length, 0, 0, set())
        found = load_block(self._stream, block)
        for record in found:
            self._declare(record)
        messages = [record for record in found if isinstance(record, Message)]
        if messages:
            self._contents.counts.update(message.channel_id for message in messages)
            block.start_ns = min(message.log_time for message in messages)
            block.end_ns = max(message.log_time for message in messages)
            block.channels = {message.channel_id for message in messages}
            self._contents.blocks.append(block)

    def _add_plain_message(self, place: _Place) -> None:
        """Add a message outside a chunk to the block before it, or start a block with it."""
        if place.length < _MESSAGE_BYTES:
            raise ValueError(f"a message of {place.length} bytes")
        self._stream.seek(place.offset + _RECORD_HEADER.size)
        message = Message.read(ReadDataStream(self._stream), _MESSAGE_HEADER_BYTES)
        blocks, time_ns = self._contents.blocks, message.log_time
        last = blocks[-1] if blocks else None
        if (
            last is None
            or last.offset + last.length != place.offset
            or last.length > _PLAIN_BLOCK_BYTES
        ):
            last = Block(Kind.PLAIN, place.offset, 0, time_ns, time_ns, set())
            blocks.append(last)
        last.length += place.length
        last.start_ns, last.end_ns = min(last.start_ns, time_ns), max(last.end_ns, time_ns)
        last.channels.add(message.channel_id)
        self._contents.counts[message.channel_id] += 1

    def _note_problems(self) -> None:
        counts, channels = self._contents.counts, self._contents.channels
        unknown = sum(count for number, count in counts.items() if number not in channels)
        name, total = f"'{self._contents.path}'", sum(counts.values()) - unknown
        if not self._data_ended:
            unread = self._size - self._end
            self._contents.problems.append(
                f"{name} breaks off after {total} messages without its index, with {unread} bytes "
                "that cannot be read (it was cut off, probably by a kill or a full disk, or is "
                "still being recorded)"
            )
        elif not self._summary_is_sound:
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
