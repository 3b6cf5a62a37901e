"""The records of an MCAP file, read with the suspicion a damaged file deserves.

The format is specified at https://mcap.dev/spec. Every length is compared with what is there before
anything is allocated or read.
"""

from __future__ import annotations

import importlib
import struct
import zlib
from collections.abc import Callable, Iterator
from typing import BinaryIO, NamedTuple

import zstandard

MAGIC = b"\x89MCAP0\r\n"

NOTHING = 0x00  # no record has this: where it is, a file was never written
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK = 0x01, 0x02, 0x03, 0x04, 0x05, 0x06
MESSAGE_INDEX, CHUNK_INDEX, ATTACHMENT_INDEX, STATISTICS = 0x07, 0x08, 0x0A, 0x0B
METADATA, METADATA_INDEX, SUMMARY_OFFSET, DATA_END = 0x0C, 0x0D, 0x0E, 0x0F

RECORD_HEADER = struct.Struct("<BQ")
MESSAGE_HEADER = struct.Struct("<HIQQ")
_FOOTER = struct.Struct("<QQI")
_CHUNK_HEADER = struct.Struct("<QQQI")
_CHUNK_INDEX_HEADER = struct.Struct("<QQQQ")
_STATISTICS_HEADER = struct.Struct("<QHIIIIQQ")
_ID_AND_NUMBER = struct.Struct("<HQ")

_LIMIT_BYTES = 2**30


class DamagedError(Exception):
    """Bytes that do not make sense; stays inside this package."""


class Schema(NamedTuple):
    """A message type: its name, the encoding of its definition, and the definition."""

    number: int
    name: str
    encoding: str
    text: str


class Channel(NamedTuple):
    """A topic of a file."""

    number: int
    schema: int
    topic: str
    encoding: str
    metadata: dict[str, str]


class Footer(NamedTuple):
    """Where the summary starts (0: there is none), and its checksum (0: not computed)."""

    summary_start: int
    summary_crc: int


class ChunkIndex(NamedTuple):
    """Where a chunk is, its span of log times [ns], and the channels in it (None: not told)."""

    start_ns: int
    end_ns: int
    offset: int
    length: int
    channels: frozenset[int] | None


class Statistics(NamedTuple):
    """Numbers of messages and chunks in a file."""

    message_count: int
    chunk_count: int
    counts: dict[int, int]


class Record(NamedTuple):
    """Position of a record's content in a buffer."""

    opcode: int
    start: int
    end: int


class Cursor:
    """Reads fields one after the other from a part of a buffer."""

    def __init__(self, data: bytes, start: int = 0, end: int | None = None) -> None:
        """Start at ``start``; nothing from ``end`` on is read."""
        self._data = data
        self.position = start
        self._end = len(data) if end is None else end

    @property
    def remaining(self) -> int:
        """Number of bytes left."""
        return self._end - self.position

    def take(self, length: int) -> bytes:
        """The next ``length`` bytes.

        Raises:
            DamagedError: There are not as many.
        """
        if length > self.remaining:
            raise DamagedError(f"a length of {length} bytes where {self.remaining} are left")
        self.position += length
        return self._data[self.position - length : self.position]

    def unpack(self, layout: struct.Struct) -> tuple[int, ...]:
        """The next numbers."""
        return layout.unpack(self.take(layout.size))

    def number(self, size: int) -> int:
        """The next number of ``size`` bytes."""
        return int.from_bytes(self.take(size), "little")

    def text(self) -> str:
        """The next text, preceded by its length."""
        data = self.take(self.number(4))
        try:
            return data.decode()
        except UnicodeDecodeError as error:
            raise DamagedError("a text is not UTF-8") from error

    def pairs(self) -> Iterator[Cursor]:
        """This cursor again and again until the end of the map that comes next."""
        size = self.number(4)
        if size > self.remaining:
            raise DamagedError(f"a map of {size} bytes where {self.remaining} are left")
        end = self.position + size
        while self.position < end:
            yield self
        if self.position != end:
            raise DamagedError("a map overruns its length")


def records(data: bytes, *, cut: bool = False) -> Iterator[Record]:
    """Records in a buffer.

    Args:
        data: The buffer.
        cut: The last record may be incomplete, which ends the iteration.

    Raises:
        DamagedError: The buffer does not end with the end of a record, without ``cut``.
    """
    position, size = 0, len(data)
    while position + RECORD_HEADER.size <= size:
        opcode, length = RECORD_HEADER.unpack_from(data, position)
        start = position + RECORD_HEADER.size
        if length > size - start or opcode == NOTHING:
            break
        position = start + length
        yield Record(opcode, start, position)
    if position < size and not cut:
        raise DamagedError(f"a record breaks off {size - position} bytes before the end")


def message_header(data: bytes, record: Record) -> tuple[int, int, int]:
    """Channel, log time [ns] and publish time [ns] of a message record."""
    if record.end - record.start < MESSAGE_HEADER.size:
        raise DamagedError(f"a message of {record.end - record.start} bytes")
    channel, _, log_ns, publish_ns = MESSAGE_HEADER.unpack_from(data, record.start)
    return channel, log_ns, publish_ns


def parse_schema(cursor: Cursor) -> Schema:
    """Read the content of a schema record, where a definition need not be UTF-8."""
    number, name, encoding = cursor.number(2), cursor.text(), cursor.text()
    return Schema(number, name, encoding, cursor.take(cursor.number(4)).decode(errors="replace"))


def parse_channel(cursor: Cursor) -> Channel:
    """Read the content of a channel record."""
    number, schema = cursor.number(2), cursor.number(2)
    topic, encoding = cursor.text(), cursor.text()
    metadata = {pair.text(): pair.text() for pair in cursor.pairs()}
    return Channel(number, schema, topic, encoding, metadata)


def parse_footer(cursor: Cursor) -> Footer:
    """Read the content of a footer record."""
    summary_start, _, summary_crc = cursor.unpack(_FOOTER)
    return Footer(summary_start, summary_crc)


def parse_chunk_index(cursor: Cursor) -> ChunkIndex:
    """Read the content of a chunk index record."""
    start_ns, end_ns, offset, length = cursor.unpack(_CHUNK_INDEX_HEADER)
    channels = frozenset(pair.unpack(_ID_AND_NUMBER)[0] for pair in cursor.pairs())
    return ChunkIndex(start_ns, end_ns, offset, length, channels or None)


def parse_statistics(cursor: Cursor) -> Statistics:
    """Read the content of a statistics record."""
    message_count, _, _, _, _, chunk_count, _, _ = cursor.unpack(_STATISTICS_HEADER)
    counts: dict[int, int] = {}
    for pair in cursor.pairs():
        channel, count = pair.unpack(_ID_AND_NUMBER)
        counts[channel] = count
    return Statistics(message_count, chunk_count, counts)


def unpack_chunk(cursor: Cursor) -> bytes:
    """Decompress the content of a chunk record.

    Returns:
        The records in the chunk.

    Raises:
        DamagedError: The content does not have the length or the checksum it should have.
    """
    size, crc, compression = _chunk_header(cursor)
    packed = cursor.take(cursor.number(8))
    if cursor.remaining:
        raise DamagedError(f"{cursor.remaining} bytes too many in a chunk")
    return _decompress(packed, compression, size, crc)


def salvage_chunk(cursor: Cursor) -> bytes:
    """Get what there is of a chunk record whose end is missing.

    Returns:
        The beginning of the records in the chunk; the last one may be incomplete.

    Raises:
        DamagedError: Nothing can be got.
    """
    size, crc, compression = _chunk_header(cursor)
    length = cursor.number(8)
    packed = cursor.take(min(length, cursor.remaining))
    if len(packed) == length:
        return _decompress(packed, compression, size, crc)
    if compression == "":
        return packed
    if compression != "zstd" or size > _LIMIT_BYTES:
        raise DamagedError("a chunk breaks off")
    try:
        return zstandard.ZstdDecompressor().stream_reader(packed).read(size)
    except (zstandard.ZstdError, MemoryError) as error:
        raise DamagedError("a chunk breaks off") from error


def read_at(stream: BinaryIO, offset: int, length: int) -> bytes:
    """Read part of a file.

    Raises:
        DamagedError: The file is too short, or the part larger than any record there is.
    """
    _check_size(length)
    stream.seek(offset)
    data = stream.read(length)
    if len(data) != length:
        raise DamagedError(f"the file ends {length - len(data)} bytes too early")
    return data


def _chunk_header(cursor: Cursor) -> tuple[int, int, str]:
    _, _, size, crc = cursor.unpack(_CHUNK_HEADER)
    return size, crc, cursor.text()


def _decompress(packed: bytes, compression: str, size: int, crc: int) -> bytes:
    data = _decompressor(compression)(packed, size)
    if len(data) != size:
        raise DamagedError(f"a chunk of {len(data)} bytes that should have {size}")
    if crc and zlib.crc32(data) != crc:
        raise DamagedError("a chunk with a wrong checksum")
    return data


def _decompressor(compression: str) -> Callable[[bytes, int], bytes]:
    known = {"": _keep, "zstd": _unpack_zstd, "lz4": _unpack_lz4}
    if compression not in known:
        raise DamagedError(f"a chunk with compression {compression!r}, known are zstd and lz4")
    return known[compression]


def _keep(packed: bytes, size: int) -> bytes:
    return packed


def _unpack_zstd(packed: bytes, size: int) -> bytes:
    _check_size(size)
    try:
        declared = zstandard.frame_content_size(packed)
        if declared not in (-1, size):  # -1: the frame does not tell
            raise DamagedError(f"a chunk of {declared} bytes that should have {size}")
        return zstandard.ZstdDecompressor().decompress(packed, max_output_size=size)
    except (zstandard.ZstdError, MemoryError) as error:
        raise DamagedError(f"a chunk that cannot be decompressed ({error})") from error


def _unpack_lz4(packed: bytes, size: int) -> bytes:
    _check_size(size)
    try:
        lz4 = importlib.import_module("lz4.frame")
    except ImportError as error:
        raise DamagedError("a chunk compressed with lz4 (install the package 'lz4')") from error
    try:
        return bytes(lz4.LZ4FrameDecompressor().decompress(packed, max_length=size + 1))
    except (RuntimeError, MemoryError) as error:
        raise DamagedError(f"a chunk that cannot be decompressed ({error})") from error


def _check_size(size: int) -> None:
    if size > _LIMIT_BYTES:
        raise DamagedError(f"a length of {size} bytes, which is too much")
