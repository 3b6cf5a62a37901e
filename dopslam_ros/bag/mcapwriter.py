"""The records of an MCAP file, written: chunks of messages, each with its index, and a summary.

The format is specified at https://mcap.dev/spec; ``records`` reads it. A recorder writes thousands
of small messages a second through this: each costs one struct.
"""

from __future__ import annotations

import struct
import zlib
from collections import Counter
from collections.abc import Mapping
from itertools import chain
from typing import Protocol

import zstandard

from dopslam_ros.bag import records

_COMPRESSION = "zstd"
_MESSAGE = struct.Struct("<BQHIQQ")  # record header, then channel, sequence, log and publish time


class Sink(Protocol):
    """Where the bytes go."""

    def write(self, data: bytes) -> int:
        """Append bytes."""

    def tell(self) -> int:
        """Offset of the next byte."""


class McapWriter:
    """Writes an MCAP file record by record."""

    def __init__(self, sink: Sink, chunk_bytes: int, library: str) -> None:
        """Write the beginning.

        Args:
            sink: Gets the bytes.
            chunk_bytes: Size before compression above which a chunk is finished.
            library: Who writes.
        """
        self._sink = sink
        self._chunk_bytes = chunk_bytes
        self._compressor = zstandard.ZstdCompressor()
        self._schemas: list[bytes] = []
        self._channels: list[bytes] = []
        self._counts: Counter[int] = Counter()
        self._chunk_indexes: list[bytes] = []
        self._metadata_indexes: list[bytes] = []
        self._spans: list[tuple[int, int]] = []  # of each chunk, by log time
        self._begin_chunk()
        sink.write(records.MAGIC + _record(records.HEADER, _text("ros2"), _text(library)))

    def add_schema(self, name: str, encoding: str, definition: bytes) -> int:
        """Declare a message type; returns its number."""
        number = len(self._schemas) + 1
        self._schemas.append(
            _record(
                records.SCHEMA,
                struct.pack("<H", number),
                _text(name),
                _text(encoding),
                struct.pack("<I", len(definition)),
                definition,
            )
        )
        self._append(self._schemas[-1])
        return number

    def add_channel(self, schema: int, topic: str, metadata: Mapping[str, str]) -> int:
        """Declare a topic with messages in CDR; returns its number."""
        number = len(self._channels) + 1
        self._channels.append(
            _record(
                records.CHANNEL,
                struct.pack("<HH", number, schema),
                _text(topic),
                _text("cdr"),
                _pairs(metadata),
            )
        )
        self._append(self._channels[-1])
        return number

    def add_message(self, channel: int, log_ns: int, publish_ns: int, payload: bytes) -> None:
        """Append a message to the chunk in progress, and finish that when it is large."""
        self._index.setdefault(channel, []).append((log_ns, self._size))
        size = len(payload) + records.MESSAGE_HEADER.size
        self._parts.append(
            _MESSAGE.pack(records.MESSAGE, size, channel, 0, log_ns, publish_ns) + payload
        )
        self._size += records.RECORD_HEADER.size + size
        if self._size > self._chunk_bytes:
            self.finish_chunk()

    def finish_chunk(self) -> None:
        """Hand the chunk in progress on; one without messages waits for some."""
        if not self._index:
            return
        data = b"".join(self._parts)
        packed = self._compressor.compress(data)
        times = [entry[0] for entries in self._index.values() for entry in entries]
        span, start = (min(times), max(times)), self._sink.tell()
        chunk = _record(
            records.CHUNK,
            struct.pack("<QQQI", *span, len(data), zlib.crc32(data)),
            _text(_COMPRESSION),
            struct.pack("<Q", len(packed)),
            packed,
        )
        indexes, offsets = self._message_indexes(start + len(chunk))
        self._sink.write(chunk + indexes)
        self._spans.append(span)
        self._chunk_indexes.append(
            _record(
                records.CHUNK_INDEX,
                struct.pack("<QQQQI", *span, start, len(chunk), len(offsets)),
                offsets,
                struct.pack("<Q", len(indexes)),
                _text(_COMPRESSION),
                struct.pack("<QQ", len(packed), len(data)),
            )
        )
        self._begin_chunk()

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Append named texts."""
        record = _record(records.METADATA, _text(name), _pairs(values))
        position = struct.pack("<QQ", self._sink.tell(), len(record))
        self._metadata_indexes.append(_record(records.METADATA_INDEX, position, _text(name)))
        self._sink.write(record)

    @property
    def span(self) -> tuple[int | None, int | None]:
        """First and last log time in finished chunks [ns]."""
        first = min((span[0] for span in self._spans), default=None)
        return first, max((span[1] for span in self._spans), default=None)

    def finish(self) -> None:
        """Write what is left and the summary: nothing may be added afterwards."""
        self.finish_chunk()
        self._sink.write(_record(records.DATA_END, bytes(4)))
        start = position = self._sink.tell()
        groups: tuple[tuple[int, list[bytes]], ...] = (
            (records.SCHEMA, self._schemas),
            (records.CHANNEL, self._channels),
            (records.STATISTICS, [self._statistics()]),
            (records.CHUNK_INDEX, self._chunk_indexes),
            (records.ATTACHMENT_INDEX, []),
            (records.METADATA_INDEX, self._metadata_indexes),
        )
        offsets = []
        for opcode, group in groups:
            size = sum(map(len, group))
            offsets.append(
                _record(records.SUMMARY_OFFSET, struct.pack("<BQQ", opcode, position, size))
            )
            position += size
        summary = b"".join(chain(*(group for _, group in groups), offsets))
        footer = struct.pack("<BQQQ", records.FOOTER, 20, start, position)
        checksum = struct.pack("<I", zlib.crc32(summary + footer))
        self._sink.write(summary + footer + checksum + records.MAGIC)

    def _message_indexes(self, position: int) -> tuple[bytes, bytes]:
        """Where the messages of each channel are in the chunk, and where in the file that is."""
        indexes, offsets = b"", b""
        for channel, entries in self._index.items():
            offsets += struct.pack("<HQ", channel, position + len(indexes))
            numbers = list(chain.from_iterable(entries))
            size = 8 * len(numbers)
            content = struct.pack(f"<HI{len(numbers)}Q", channel, size, *numbers)
            indexes += _record(records.MESSAGE_INDEX, content)
            self._counts[channel] += len(entries)
        return indexes, offsets

    def _statistics(self) -> bytes:
        first, last = self.span
        return _record(
            records.STATISTICS,
            struct.pack(
                "<QHIIIIQQI",
                self._counts.total(),
                len(self._schemas),
                len(self._channels),
                0,
                len(self._metadata_indexes),
                len(self._chunk_indexes),
                first or 0,
                last or 0,
                10 * len(self._counts),
            ),
            *(struct.pack("<HQ", *item) for item in self._counts.items()),
        )

    def _begin_chunk(self) -> None:
        self._parts: list[bytes] = []
        self._size = 0
        self._index: dict[int, list[tuple[int, int]]] = {}

    def _append(self, record: bytes) -> None:
        """Put a declaration where the messages that need it will be."""
        self._parts.append(record)
        self._size += len(record)
        if self._size > self._chunk_bytes:
            self.finish_chunk()


def _record(opcode: int, *content: bytes) -> bytes:
    data = b"".join(content)
    return records.RECORD_HEADER.pack(opcode, len(data)) + data


def _text(text: str) -> bytes:
    data = text.encode()
    return struct.pack("<I", len(data)) + data


def _pairs(values: Mapping[str, str]) -> bytes:
    """A map of texts."""
    data = b"".join(_text(key) + _text(text) for key, text in values.items())
    return struct.pack("<I", len(data)) + data
