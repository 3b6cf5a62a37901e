"""Damaged bags: whatever happened to a file, what comes out was in it."""

from __future__ import annotations

import struct
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as RosbagsWriter

from dopslam_ros.bag import BagError, BagReader, BagWriter, typestore
from dopslam_ros.bag.repair import repair

UE_STATE = "dopslam_msgs/msg/UeState"
MAGIC = b"\x89MCAP0\r\n"


def _read(data: bytes, folder: Path) -> tuple[list[tuple[Any, ...]], str | None] | None:
    """Messages in a file with this content and the damage; None when it is refused."""
    path = folder / "damaged.mcap"
    path.write_bytes(data)
    try:
        reader = BagReader(path)
        messages = [(m.topic, *m[2:]) for m in reader.messages()]
    except BagError:
        return None
    return messages, reader.damage


def _content(path: Path) -> bytes:
    return next(path.glob("*.mcap")).read_bytes()


def test_every_cut_leaves_a_beginning(tmp_path: Path, samples: Any, write_bag: Any) -> None:
    data = _content(write_bag(tmp_path / "bag", samples, 2000))
    lengths = []
    for size in [*range(40), *np.linspace(40, len(data) - 1, 230).astype(int)]:
        result = _read(data[:size], tmp_path)
        if size < len(MAGIC):
            assert result is None
        else:
            assert result is not None
            messages, damage = result
            assert messages == samples[: len(messages)]
            assert damage is not None
            lengths.append(len(messages))
    assert lengths == sorted(lengths)
    assert lengths[-1] == 300


def test_cut_costs_at_most_the_chunk_it_hits(tmp_path: Path, samples: Any, write_bag: Any) -> None:
    data = _content(write_bag(tmp_path / "bag", samples, 2000))
    (half, damage) = _read(data[: len(data) // 2], tmp_path) or ([], None)
    assert len(half) > 100
    assert damage is not None
    assert f"breaks off after {len(half)} messages without its index" in damage
    assert "killed" not in damage
    assert "by a kill or a full disk" in damage
    assert "dopslam recover" in damage


@pytest.mark.parametrize("compressed", [False, True])
def test_cut_inside_a_large_chunk(tmp_path: Path, samples: Any, compressed: bool) -> None:
    """Of a chunk of rosbag2 without compression nothing is lost but the message that is cut."""
    writer = RosbagsWriter(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP)
    with writer:
        connection = writer.add_connection("/state", UE_STATE, typestore=typestore())
        for sample in samples:
            writer.write(connection, sample.log_time_ns, sample.payload)
    data = _content(tmp_path / "bag")
    payloads = [sample.payload for sample in samples]
    for size in np.linspace(2000, 50_000, 50).astype(int):
        result = _read(data[:size], tmp_path)
        assert result is not None
        found = [message[3] for message in result[0]]
        assert found == payloads[: len(found)]
        assert sum(len(payload) + 31 for payload in found) > size - 2500


def test_flipped_bits_add_nothing(tmp_path: Path, samples: Any, write_bag: Any) -> None:
    data = _content(write_bag(tmp_path / "bag", samples, 2000))
    available, rng = Counter(samples), np.random.default_rng(6)
    complete = 0
    for _ in range(400):
        damaged = bytearray(data)
        for position in rng.integers(len(data), size=int(rng.integers(1, 4))):
            damaged[position] ^= 1 << int(rng.integers(8))
        result = _read(bytes(damaged), tmp_path)
        if result is not None:
            assert Counter(result[0]) <= available
            assert len(result[0]) == 300 or result[1] is not None
            complete += len(result[0]) > 200
    assert complete > 200


def test_flipped_bits_of_a_cut_file(tmp_path: Path, samples: Any, write_bag: Any) -> None:
    data = _content(write_bag(tmp_path / "bag", samples, 2000))
    data = data[: len(data) * 2 // 3]
    available, rng = Counter(samples), np.random.default_rng(7)
    for _ in range(300):
        damaged = bytearray(data)
        damaged[int(rng.integers(len(data)))] ^= 1 << int(rng.integers(8))
        result = _read(bytes(damaged), tmp_path)
        assert result is None or Counter(result[0]) <= available


def test_overwritten_regions(tmp_path: Path, samples: Any, write_bag: Any) -> None:
    data = _content(write_bag(tmp_path / "bag", samples, 2000))
    available, rng = Counter(samples), np.random.default_rng(8)
    for number in range(200):
        begin, length = int(rng.integers(len(data))), int(rng.integers(1, 3000))
        patch = bytes(length) if number % 2 else rng.bytes(length)
        result = _read(data[:begin] + patch + data[begin + length :], tmp_path)
        assert result is None or Counter(result[0]) <= available


def test_garbage_after_the_magic(tmp_path: Path) -> None:
    rng = np.random.default_rng(9)
    for _ in range(200):
        result = _read(MAGIC + rng.bytes(int(rng.integers(0, 500))), tmp_path)
        assert result is None or result[0] == []


def test_damage_inside_an_indexed_file_costs_one_chunk(
    tmp_path: Path, samples: Any, write_bag: Any
) -> None:
    path = write_bag(tmp_path / "bag", samples, 2000)
    file = path / "bag_0.mcap"
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 0x10
    file.write_bytes(data)
    reader = BagReader(path)
    for _ in range(2):
        assert 285 <= sum(1 for _ in reader.messages()) < 300
    assert reader.damage is not None
    assert reader.damage.count("is left out") == 1


def test_a_damaged_summary_is_not_believed(tmp_path: Path, samples: Any, write_bag: Any) -> None:
    """A topic has another name in there: the one that the chunks tell is right."""
    data = bytearray(_content(write_bag(tmp_path / "bag", samples, 2000)))
    (summary_start,) = struct.unpack_from("<Q", data, len(data) - 28)
    data[data.index(b"/state", summary_start) + 1] ^= 1
    result = _read(bytes(data), tmp_path)
    assert result is not None
    assert result[0] == samples
    assert result[1] is not None and "300 messages were found without it" in result[1]
    data[data.index(b"zstd") + 100] ^= 1  # in the chunk that declares the topics
    messages, damage = _read(bytes(data), tmp_path) or (samples, None)
    assert messages == []
    assert damage is not None and "the record of their topic is lost" in damage


def _record(opcode: int, content: bytes, length: int | None = None) -> bytes:
    return struct.pack("<BQ", opcode, len(content) if length is None else length) + content


def _chunk(packed: bytes, size: int, compression: bytes, length: int | None = None) -> bytes:
    header = struct.pack("<QQQI", 0, 0, size, 0) + struct.pack("<I", len(compression))
    number = len(packed) if length is None else length
    return _record(6, header + compression + struct.pack("<Q", number) + packed)


def _claiming_frame(size: int) -> bytes:
    """A zstd frame that says it contains ``size`` bytes."""
    return b"\x28\xb5\x2f\xfd\xe0" + struct.pack("<Q", size) + b"\x01\x00\x00"


BOMB = zstandard.compress(bytes(2**28))
CHANNEL = _record(4, struct.pack("<HHIsIsI", 1, 0, 1, b"x", 1, b"x", 0))
MESSAGE = _record(5, struct.pack("<HIQQ", 1, 0, 0, 0) + b"payload")
LONG = CHANNEL + _record(5, struct.pack("<HIQQ", 1, 0, 0, 0) + b"payload", 99)
SHORT = CHANNEL + _record(5, b"\1\0") + MESSAGE
LIES = {
    "record": _record(6, b"", 2**63),
    "record of all ones": _record(5, b"", 2**64 - 1),
    "schema": _record(3, struct.pack("<HI", 1, 2**32 - 1)),
    "channel": _record(4, struct.pack("<HHII", 1, 1, 0, 0) + struct.pack("<I", 2**31)),
    "chunk": _chunk(b"x", 1, b"", 2**62),
    "zstd size": _chunk(zstandard.compress(b"x"), 2**62, b"zstd"),
    "zstd frame": _chunk(_claiming_frame(2**40), 100, b"zstd"),
    "zstd frame and size": _chunk(_claiming_frame(2**40), 2**40, b"zstd"),
    "zstd bomb": _chunk(BOMB, 100, b"zstd"),
    "lz4 size": _chunk(b"\x04\x22\x4d\x18", 2**62, b"lz4"),
    "unknown compression": _chunk(b"x", 1, b"brotli"),
    "message": _record(5, b"short"),
    "message longer than its chunk": _chunk(LONG, len(LONG), b""),
    "message shorter than its header": _chunk(SHORT, len(SHORT), b""),
    "message beside chunks": _chunk(CHANNEL, len(CHANNEL), b"") + MESSAGE,
    "nested": _chunk(_chunk(b"", 0, b""), len(_chunk(b"", 0, b"")), b""),
    "empty records": _record(0, b"") * 2000,
}


@pytest.mark.parametrize("lie", LIES)
def test_lengths_are_not_believed(tmp_path: Path, lie: str) -> None:
    begin = time.monotonic()
    result = _read(MAGIC + _record(1, bytes(8)) + LIES[lie], tmp_path)
    assert result is not None
    messages, damage = result
    assert messages == []
    assert damage is not None
    assert time.monotonic() - begin < 1.0


def test_a_message_without_its_header_costs_no_other(tmp_path: Path) -> None:
    data = MAGIC + _record(1, bytes(8)) + CHANNEL + MESSAGE + _record(5, b"\1\0") + MESSAGE
    messages, _ = _read(data, tmp_path) or ([], None)
    assert messages == [("x", 0, 0, b"payload")] * 2


def test_file_that_ends_in_zeros(tmp_path: Path, samples: Any, write_bag: Any) -> None:
    """So a file may look after a power failure; nobody shall wait for a billion empty records."""
    data = _content(write_bag(tmp_path / "bag", samples, 2000))
    path = tmp_path / "zeros.mcap"
    with path.open("wb") as stream:
        stream.write(data[: len(data) // 2])
        stream.truncate(2**34)
    begin = time.monotonic()
    found = [(m.topic, *m[2:]) for m in BagReader(path).messages()]
    assert found == samples[: len(found)]
    assert len(found) > 100
    assert time.monotonic() - begin < 1.0


def test_index_that_points_elsewhere(tmp_path: Path, samples: Any, write_bag: Any) -> None:
    """An index without checksum, its numbers changed one after the other."""
    data = _content(write_bag(tmp_path / "bag", samples, 2000))
    available = Counter(samples)
    summary_start = struct.unpack_from("<Q", data, len(data) - 28)[0]
    rng = np.random.default_rng(10)
    for position in rng.integers(summary_start, len(data) - 8, size=300):
        damaged = bytearray(data)
        damaged[-12:-8] = bytes(4)
        if position < len(data) - 12:
            damaged[position] ^= 1 << int(rng.integers(8))
        result = _read(bytes(damaged), tmp_path)
        if result is not None:
            payloads = Counter(message[3] for message in result[0])
            assert payloads <= Counter(sample.payload for sample in available.elements())


def test_bag_that_is_still_being_recorded(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        writer.add_topic("/state", UE_STATE)
        writer.write("/state", b"1", 1)
        writer.flush()
        reader = BagReader(tmp_path / "bag")
        assert [m.payload for m in reader.messages()] == [b"1"]
        assert reader.damage is not None
        assert "still being recorded" in reader.damage
    assert BagReader(tmp_path / "bag").damage is None


def test_repair_makes_a_whole_bag(tmp_path: Path, samples: Any, write_bag: Any) -> None:
    data = _content(write_bag(tmp_path / "bag", samples, 2000))
    (tmp_path / "cut.mcap").write_bytes(data[: len(data) // 2])
    reader = repair(tmp_path / "cut.mcap", tmp_path / "saved")
    saved = BagReader(tmp_path / "saved")
    assert saved.damage is None
    assert list(saved.messages()) == list(reader.messages())
    assert saved.topics == reader.topics
    with AnyReader([tmp_path / "saved"]) as witness:
        assert sum(1 for _ in witness.messages()) == reader.message_count > 100
