"""The records of an MCAP file, which the library ``mcap`` reads once their claims are doubted.

The format is specified at https://mcap.dev/spec. Every length is compared with what is there before
memory is taken for it, and of what has no checksum every record must end where the next one starts.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from dataclasses import replace
from io import BytesIO
from typing import BinaryIO, NamedTuple

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Chunk, McapRecord
from mcap.stream_reader import breakup_chunk, get_chunk_data_stream

from dopslam_ros.bag.contents import Block, Kind

RECORD_HEADER = struct.Struct("<BQ")  # opcode and length of what follows
MESSAGE_HEADER_BYTES = 22
MESSAGE_BYTES = RECORD_HEADER.size + MESSAGE_HEADER_BYTES  # of one without content

# Whatever mcap and the libraries below it raise at bytes that do not make sense.
DAMAGE = (
    McapError, ValueError, OverflowError, MemoryError, RuntimeError, struct.error,
    zstandard.ZstdError,
)  # fmt: skip

_NOTHING = 0x00  # no record has this opcode: where it is, a file was never written
_LIMIT_BYTES = 2**30
# The size that a chunk's data tell; -1: none. Memory is taken for as much as a frame of zstd tells.
_SIZE_TOLD: dict[str, Callable[[bytes], int]] = {
    "": len,
    "zstd": zstandard.frame_content_size,
    "lz4": lambda data: -1,
}


class DamagedError(Exception):
    """Bytes that do not make sense; stays inside this package."""


def load_block(stream: BinaryIO, block: Block) -> list[McapRecord]:
    """Read the records of a block.

    Raises:
        DamagedError: They are damaged.
    """
    try:
        chunk = _chunk(block.kind, read_part(stream, block.offset, block.length))
        return breakup_chunk(chunk, validate_crc=True)
    except DAMAGE as error:
        raise DamagedError(f"a chunk ({str(error) or type(error).__name__})") from error


class Place(NamedTuple):
    """Where a record is, and whether the end of the file cuts it."""

    opcode: int
    offset: int
    length: int
    is_cut: bool


def places(stream: BinaryIO, offset: int, size: int) -> Iterator[Place]:
    """The records from an offset on, up to the first one that cannot be followed."""
    while offset + RECORD_HEADER.size <= size:
        stream.seek(offset)
        opcode, length = RECORD_HEADER.unpack(stream.read(RECORD_HEADER.size))
        if opcode == _NOTHING:
            return
        end = offset + RECORD_HEADER.size + length
        yield Place(opcode, offset, min(end, size) - offset, end > size)
        offset = end


def read_part(stream: BinaryIO, offset: int, length: int) -> bytes:
    """Part of a file: all of it, or ValueError."""
    if not 0 <= length <= _LIMIT_BYTES:
        raise ValueError(f"a length of {length} bytes")
    stream.seek(offset)
    data = stream.read(length)
    if len(data) != length:
        raise ValueError(f"the file ends {length - len(data)} bytes too early")
    return data


def content_of(data: bytes) -> ReadDataStream:
    """What a record contains, for mcap to read: it cannot get beyond the end of ``data``."""
    return ReadDataStream(BytesIO(data[RECORD_HEADER.size :]))


def _chunk(kind: Kind, data: bytes) -> Chunk:
    """The chunk in the bytes of a block, which is safe to unpack; raises one of ``DAMAGE``."""
    if kind is Kind.PLAIN:
        return Chunk("", data, 0, 0, 0, len(data))
    if data[:1] != bytes([Opcode.CHUNK]):
        raise ValueError("another record is in its place")
    chunk: Chunk = Chunk.read(content_of(data))
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
    for place in places(BytesIO(data), 0, len(data)):
        if place.is_cut or (place.opcode == Opcode.MESSAGE and place.length < MESSAGE_BYTES):
            break
        end = place.offset + place.length
    return end
