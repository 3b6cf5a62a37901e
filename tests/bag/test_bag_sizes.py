"""What a file claims is bounded before memory is taken for it."""

from __future__ import annotations

import struct
import tracemalloc
import zlib
from pathlib import Path
from typing import NamedTuple

import pytest
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.records import Channel, Header, Message, Schema
from mcap.writer import MCAP0_MAGIC

from dopslam_ros.bag import BagReader

PAYLOAD = bytes(range(250))
SWOLLEN = 200_000_000
MOST_MEMORY = 4_000_000


class Found(NamedTuple):
    """What came out of a file, and the most memory that was in use meanwhile [bytes]."""

    payloads: list[bytes]
    damage: str | None
    memory: int


def read(path: Path) -> Found:
    """Read all of a file."""
    tracemalloc.start()
    try:
        reader = BagReader(path)
        payloads = [message.payload for message in reader.messages()]
        return Found(payloads, reader.damage, tracemalloc.get_traced_memory()[1])
    finally:
        tracemalloc.stop()


def twenty_messages() -> bytes:
    """The content of a chunk: a type, a topic and messages on it."""
    builder = RecordBuilder()
    Schema(1, b"uint8 x\n", "ros2msg", "odd_msgs/msg/Odd").write(builder)
    Channel(1, "/odd", "cdr", {}, 1).write(builder)
    for number in range(20):
        Message(1, number, PAYLOAD, number, 0).write(builder)
    return bytes(builder.end())


def write(path: Path, packed: bytes, claimed: int, cut: int = 0, crc: int = 0) -> None:
    """Write a file of one chunk that claims a size; ``cut`` bytes fewer are there than it says."""
    builder = RecordBuilder()
    Header("ros2", "").write(builder)
    content = struct.pack("<QQQI", 0, 19, claimed, crc) + struct.pack("<I", 4) + b"zstd"
    content += struct.pack("<Q", len(packed)) + packed
    record = struct.pack("<BQ", 6, len(content) + cut) + content
    path.write_bytes(MCAP0_MAGIC + builder.end() + record)


@pytest.mark.parametrize("declared", [False, True])
def test_a_chunk_that_swells_is_not_unpacked(tmp_path: Path, declared: bool) -> None:
    """Kilobytes that would become hundreds of megabytes: refused, or cut off where it said."""
    content = twenty_messages()
    compressor = zstandard.ZstdCompressor(write_content_size=declared)
    packed = compressor.compress(content + bytes(SWOLLEN - len(content)))
    assert len(packed) < 10_000
    write(tmp_path / "whole.mcap", packed, len(content))
    whole = read(tmp_path / "whole.mcap")
    assert whole.payloads == []
    assert whole.damage is not None and "1 damaged chunk(s)" in whole.damage
    write(tmp_path / "cut.mcap", packed[:-1], len(content) + 5000, cut=1)
    cut = read(tmp_path / "cut.mcap")
    assert cut.payloads == [PAYLOAD] * 20
    assert max(whole.memory, cut.memory) < MOST_MEMORY


def test_of_a_cut_chunk_only_what_it_claims_is_kept(tmp_path: Path) -> None:
    """It claims to have half a message less than is there."""
    content = twenty_messages()
    packed = zstandard.ZstdCompressor().compress(content + bytes(SWOLLEN - len(content)))
    write(tmp_path / "cut.mcap", packed[:-1], len(content) - len(PAYLOAD) // 2, cut=1)
    found = read(tmp_path / "cut.mcap")
    assert found.damage is not None
    assert found.payloads == [PAYLOAD] * 19


@pytest.mark.parametrize(("wrong", "count"), [(0, 20), (1, 0)])
def test_a_cut_record_with_all_of_its_chunk(tmp_path: Path, wrong: int, count: int) -> None:
    """Its checksum tells whether that is as it was written."""
    content = twenty_messages()
    crc = zlib.crc32(content) ^ wrong
    write(tmp_path / "cut.mcap", zstandard.compress(content), len(content), cut=9, crc=crc)
    found = read(tmp_path / "cut.mcap")
    assert found.payloads == [PAYLOAD] * count
    assert found.damage is not None and f"breaks off after {count} messages" in found.damage


@pytest.mark.parametrize("cut", [0, 1])
@pytest.mark.parametrize("claimed", [1 << 33, 1 << 40, (1 << 64) - 1])
def test_a_chunk_that_claims_too_much_is_refused(tmp_path: Path, claimed: int, cut: int) -> None:
    """No memory is taken for a size that no chunk has."""
    packed = zstandard.ZstdCompressor(write_content_size=False).compress(twenty_messages())
    write(tmp_path / "bag.mcap", packed, claimed, cut)
    found = read(tmp_path / "bag.mcap")
    assert found.payloads == []
    assert found.damage is not None
    assert found.memory < MOST_MEMORY
