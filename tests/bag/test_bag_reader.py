"""Reading bags that others wrote, in every shape the format allows."""

from __future__ import annotations

import random
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as RosbagsWriter

from dopslam_ros.bag import (
    BagError,
    BagFormatError,
    BagReader,
    BagWriter,
    Reliability,
    definition,
    type_hash,
    typestore,
)

UE_STATE = "dopslam_msgs/msg/UeState"


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("version", [8, 9])
def test_bag_of_rosbags(tmp_path: Path, samples: Any, version: Any, compressed: bool) -> None:
    qos = Qos(
        QosHistory.KEEP_LAST,
        5,
        QosReliability.BEST_EFFORT,
        QosDurability.VOLATILE,
        QosTime(0, 0),
        QosTime(0, 0),
        QosLiveliness.AUTOMATIC,
        QosTime(0, 0),
        False,
    )
    writer = RosbagsWriter(tmp_path / "bag", version=version, storage_plugin=StoragePlugin.MCAP)
    if compressed:
        writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    with writer:
        connections = {
            topic: writer.add_connection(
                topic, UE_STATE, typestore=typestore(), offered_qos_profiles=[qos]
            )
            for topic in ("/state", "/odometry")
        }
        for sample in samples:
            writer.write(connections[sample.topic], sample.log_time_ns, sample.payload)
    reader = BagReader(tmp_path / "bag")
    assert reader.damage is None
    read = [(m.topic, m.type_name, m.log_time_ns, m.payload) for m in reader.messages()]
    assert read == [(s.topic, UE_STATE, s.log_time_ns, s.payload) for s in samples]
    info = reader.topics["/state"]
    assert info.type_name == UE_STATE
    assert info.message_count == sum(s.topic == "/state" for s in samples)
    assert (info.qos[0].reliability, info.qos[0].depth) == (Reliability.BEST_EFFORT, 5)


SHAPES: dict[str, dict[str, Any]] = {
    "usual": {},
    "no chunks": {"use_chunking": False},
    "small chunks": {"chunk_size": 1000},
    "no compression": {"compression": CompressionType.NONE, "chunk_size": 3000},
    "lz4": {"compression": CompressionType.LZ4, "chunk_size": 3000},
    "no indexes": {"index_types": IndexType.NONE, "chunk_size": 3000},
    "no message index": {"index_types": IndexType.CHUNK, "chunk_size": 3000},
    "no statistics": {"use_statistics": False, "chunk_size": 3000},
    "no repeated channels": {"repeat_channels": False, "chunk_size": 3000},
    "no repeated schemas": {"repeat_schemas": False, "chunk_size": 3000},
    "no summary": {
        "index_types": IndexType.NONE,
        "repeat_channels": False,
        "repeat_schemas": False,
        "use_statistics": False,
        "use_summary_offsets": False,
        "chunk_size": 3000,
    },
    "no checksums": {"enable_crcs": False, "chunk_size": 3000},
    "checksum of all": {"enable_data_crcs": True, "chunk_size": 3000},
}


def _write_mcap(path: Path, samples: Any, **options: Any) -> None:
    with path.open("wb") as stream:
        writer = Writer(stream, **options)
        writer.start("ros2")
        writer.add_attachment(1, 1, "photo", "image/png", bytes(2000))
        schema = writer.register_schema(UE_STATE, "ros2msg", b"float64 x\n")
        channels = {
            topic: writer.register_channel(topic, "cdr", schema)
            for topic in ("/state", "/odometry")
        }
        for sample in samples:
            writer.add_message(
                channels[sample.topic], sample.log_time_ns, sample.payload, sample.publish_time_ns
            )
        writer.add_metadata("anything", {"key": "value"})
        writer.finish()


@pytest.mark.parametrize("order", ["sorted", "shuffled", "constant", "backwards"])
@pytest.mark.parametrize("shape", SHAPES)
def test_shapes_of_mcap_files(tmp_path: Path, samples: Any, shape: str, order: str) -> None:
    if order == "shuffled":
        random.Random(4).shuffle(samples)
    elif order == "constant":
        samples = [sample._replace(log_time_ns=7) for sample in samples]
    elif order == "backwards":
        samples.reverse()
    path = tmp_path / "file.mcap"
    _write_mcap(path, samples, **SHAPES[shape])
    reader = BagReader(path)
    assert reader.damage is None
    expected = sorted(samples, key=lambda sample: sample.log_time_ns)
    assert [(m.topic, *m[2:]) for m in reader.messages()] == expected
    assert [(m.topic, *m[2:]) for m in reader.messages(["/odometry", "/none"])] == [
        sample for sample in expected if sample.topic == "/odometry"
    ]
    assert reader.start_time_ns == expected[0].log_time_ns
    assert reader.end_time_ns == expected[-1].log_time_ns
    assert {t: i.message_count for t, i in reader.topics.items()} == {
        topic: sum(sample.topic == topic for sample in samples) for topic in ("/state", "/odometry")
    }
    assert {i.type_name for i in reader.topics.values()} == {UE_STATE}


@pytest.mark.parametrize("shape", ["usual", "no chunks", "no indexes", "lz4"])
def test_memory_is_that_of_a_part_of_the_file(tmp_path: Path, samples: Any, shape: str) -> None:
    payload = np.random.default_rng(6).bytes(60_000)
    samples = [samples[0]._replace(log_time_ns=n, payload=payload) for n in range(500)]
    _write_mcap(tmp_path / "file.mcap", samples, **SHAPES[shape])
    tracemalloc.start()
    try:
        assert sum(1 for _ in BagReader(tmp_path / "file.mcap").messages()) == 500
        assert tracemalloc.get_traced_memory()[1] < 10_000_000
    finally:
        tracemalloc.stop()


def test_order_is_that_of_mcap(tmp_path: Path, samples: Any, write_bag: Any) -> None:
    random.Random(5).shuffle(samples)
    path = write_bag(tmp_path / "bag", samples, 700)
    with (path / "bag_0.mcap").open("rb") as stream:
        reference = [m.data for _, _, m in make_reader(stream).iter_messages()]
    assert [m.payload for m in BagReader(path).messages()] == reference


def _split_bag(path: Path, samples: Any, write_bag: Any, parts: int) -> None:
    """Distribute samples over the files of one bag as ``ros2 bag record`` does when it splits."""
    path.mkdir()
    names = []
    for number in range(parts):
        part = write_bag(path.parent / f"part{number}", samples[number::parts])
        names.append(f"{path.name}_{number}.mcap")
        next(part.glob("*.mcap")).rename(path / names[-1])
    information = {"relative_file_paths": names}
    (path / "metadata.yaml").write_text(yaml.dump({"rosbag2_bagfile_information": information}))


@pytest.mark.parametrize("with_metadata", [True, False])
def test_splits_are_merged(
    tmp_path: Path, samples: Any, write_bag: Any, with_metadata: bool
) -> None:
    _split_bag(tmp_path / "bag", samples, write_bag, 12)
    if not with_metadata:
        (tmp_path / "bag" / "metadata.yaml").unlink()
    reader = BagReader(tmp_path / "bag")
    assert reader.damage is None
    assert [(m.topic, *m[2:]) for m in reader.messages()] == samples
    assert reader.message_count == 300


def test_splits_of_equal_time_are_read_in_the_order_of_their_numbers(
    tmp_path: Path, samples: Any, write_bag: Any
) -> None:
    samples = [sample._replace(log_time_ns=7) for sample in samples]
    _split_bag(tmp_path / "bag", samples, write_bag, 12)
    (tmp_path / "bag" / "metadata.yaml").unlink()
    found = [(m.topic, *m[2:]) for m in BagReader(tmp_path / "bag").messages()]
    assert found == [sample for number in range(12) for sample in samples[number::12]]


def test_missing_split_is_damage(tmp_path: Path, samples: Any, write_bag: Any) -> None:
    _split_bag(tmp_path / "bag", samples, write_bag, 3)
    (tmp_path / "bag" / "bag_1.mcap").unlink()
    reader = BagReader(tmp_path / "bag")
    assert reader.damage is not None
    assert "bag_1.mcap" in reader.damage
    assert reader.message_count == 200


@pytest.mark.parametrize("content", ["", "[", "5", "rosbag2_bagfile_information: 3", "\0\1"])
def test_damaged_metadata_hides_nothing(
    tmp_path: Path, samples: Any, write_bag: Any, content: str
) -> None:
    path = write_bag(tmp_path / "bag", samples)
    (path / "metadata.yaml").write_text(content)
    reader = BagReader(path)
    assert reader.message_count == 300
    assert reader.damage is not None
    assert "metadata.yaml' is damaged" in reader.damage


def test_metadata_cannot_lead_elsewhere(tmp_path: Path, samples: Any, write_bag: Any) -> None:
    write_bag(tmp_path / "other", samples)
    path = write_bag(tmp_path / "bag", samples[:3])
    text = (path / "metadata.yaml").read_text()
    (path / "metadata.yaml").write_text(text.replace("bag_0.mcap", "../other/other_0.mcap"))
    assert BagReader(path).message_count == 3


def test_a_topic_may_be_given_as_text(tmp_path: Path, samples: Any, write_bag: Any) -> None:
    reader = BagReader(write_bag(tmp_path / "bag", samples))
    assert {m.topic for m in reader.messages("/state")} == {"/state"}
    assert list(reader.messages([])) == []


def test_information_about_topics(tmp_path: Path, samples: Any, write_bag: Any) -> None:
    info = BagReader(write_bag(tmp_path / "bag", samples)).topics["/state"]
    assert (info.type_name, info.type_hash) == (UE_STATE, type_hash(UE_STATE))
    assert info.definition == definition(UE_STATE)
    assert [profile.depth for profile in info.qos] == [50]


def _make_nothing(path: Path) -> None:
    """There is no such path."""


WRONG: dict[str, tuple[Callable[[Path], object], str]] = {
    "missing": (_make_nothing, "there is no bag at"),
    "empty folder": (Path.mkdir, "no .mcap file"),
    "empty file": (Path.touch, "is empty"),
    "text": (lambda path: path.write_text("rosbag"), "no MCAP file"),
    "almost": (lambda path: path.write_bytes(b"\x89MCAP1\r\n" + bytes(99)), "no MCAP file"),
    "pipe": (lambda path: __import__("os").mkfifo(path), "there is no bag at"),
    "sqlite": (
        lambda path: (path.mkdir(), (path / "bag_0.db3").touch()),
        "SQLite.*ros2 bag convert",
    ),
    "packed": (
        lambda path: (path.mkdir(), (path / "bag_0.mcap.zstd").touch()),
        "compressed.*unzstd",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_is_no_bag(tmp_path: Path, case: str) -> None:
    make, message = WRONG[case]
    make(tmp_path / "bag")
    with pytest.raises(BagFormatError, match=message) as caught:
        BagReader(tmp_path / "bag")
    assert str(tmp_path / "bag") in str(caught.value)


def test_disk_errors_are_bag_errors(tmp_path: Path, samples: Any, write_bag: Any) -> None:
    path = write_bag(tmp_path / "bag", samples)
    reader = BagReader(path)
    (path / "bag_0.mcap").unlink()
    with pytest.raises(BagError, match="cannot be read"):
        list(reader.messages())


def test_reading_is_fast(tmp_path: Path) -> None:
    """A replay reads 100,000 messages; a third of a second is usual, and much more is a fault."""
    with BagWriter(tmp_path / "bag", flush_seconds=None) as writer:
        writer.add_topic("/state", UE_STATE)
        for number in range(20_000):
            writer.write("/state", bytes(900), number // 5000)
    begin = time.process_time()
    assert sum(1 for _ in BagReader(tmp_path / "bag").messages()) == 20_000
    assert time.process_time() - begin < 1.0
