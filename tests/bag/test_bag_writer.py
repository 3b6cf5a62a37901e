"""Writing bags, with rosbags and mcap as witnesses, and kills and full disks as enemies."""

from __future__ import annotations

import os
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any

import pytest
import yaml
from mcap.reader import make_reader
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Reader

import dopslam_ros
from dopslam_ros.bag import (
    BagError,
    BagExistsError,
    BagReader,
    BagTypeError,
    BagWriteError,
    BagWriter,
    Durability,
    OfferedQos,
    definition,
    to_yaml,
    type_hash,
)

UE_STATE = "dopslam_msgs/msg/UeState"
ODOMETRY = "nav_msgs/msg/Odometry"


def test_rosbags_takes_it_as_a_bag(tmp_path: Path, samples: Any, write_bag: Any) -> None:
    path = write_bag(tmp_path / "bag", samples)
    with Reader(path) as reader:
        read = [(c.topic, t, bytes(data)) for c, t, data in reader.messages()]
        by_topic = {connection.topic: connection for connection in reader.connections}
        assert reader.message_count == 300
        assert reader.start_time == samples[0].log_time_ns
        assert reader.end_time == samples[-1].log_time_ns + 1
    assert read == [(s.topic, s.log_time_ns, s.payload) for s in samples]
    assert {t: (c.msgtype, c.digest, c.msgcount) for t, c in by_topic.items()} == {
        "/state": (UE_STATE, type_hash(UE_STATE), sum(s.topic == "/state" for s in samples)),
        "/odometry": (ODOMETRY, type_hash(ODOMETRY), sum(s.topic != "/state" for s in samples)),
    }
    assert [q.depth for q in by_topic["/state"].ext.offered_qos_profiles] == [50]  # type: ignore[union-attr]
    with AnyReader([path]) as any_reader:
        assert sum(1 for _ in any_reader.messages()) == 300


def test_mcap_takes_it_as_a_file_of_ros2(tmp_path: Path, samples: Any, write_bag: Any) -> None:
    path = write_bag(tmp_path / "bag", samples)
    with (path / "bag_0.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        found = list(reader.iter_messages())
        (record,) = reader.iter_metadata()
    assert [(c.topic, m.log_time, m.publish_time, m.data) for _, c, m in found] == samples
    schema, channel, _ = next(row for row in found if row[1].topic == "/state")
    assert schema is not None
    assert (schema.name, schema.encoding) == (UE_STATE, "ros2msg")
    assert schema.data.decode() == definition(UE_STATE)
    assert channel.message_encoding == "cdr"
    assert set(channel.metadata) == {"offered_qos_profiles", "topic_type_hash"}
    assert record.name == "rosbag2"
    whole = yaml.safe_load((path / "metadata.yaml").read_text())
    inner = yaml.safe_load(record.metadata["serialized_metadata"])
    assert whole == {"rosbag2_bagfile_information": inner}


def test_file_is_byte_for_byte_what_mcap_writes(
    tmp_path: Path, samples: Any, write_bag: Any
) -> None:
    """The official library, told the same, writes the same file: index, statistics and all."""
    ours = (write_bag(tmp_path / "bag", samples, 3000) / "bag_0.mcap").read_bytes()
    info = BagReader(tmp_path / "bag").topics
    stream = BytesIO()
    theirs = McapWriter(stream, 3000, compression=CompressionType.ZSTD)
    theirs.start("ros2", f"dopslam_ros {dopslam_ros.__version__}")
    channels = {}
    for topic in ("/state", "/odometry"):
        kind = info[topic]
        schema = theirs.register_schema(kind.type_name, "ros2msg", kind.definition.encode())
        described = {
            "offered_qos_profiles": to_yaml(kind.qos),
            "topic_type_hash": kind.type_hash,
        }
        channels[topic] = theirs.register_channel(topic, "cdr", schema, described)
    for sample in samples:
        theirs.add_message(
            channels[sample.topic], sample.log_time_ns, sample.payload, sample.publish_time_ns
        )
    document = yaml.safe_load((tmp_path / "bag" / "metadata.yaml").read_text())
    text = (tmp_path / "bag" / "metadata.yaml").read_text().partition("\n")[2]
    inner = textwrap.dedent(text).strip()
    assert yaml.safe_load(inner) == document["rosbag2_bagfile_information"]
    theirs.flush()
    theirs.add_metadata("rosbag2", {"serialized_metadata": inner})
    theirs.finish()
    assert stream.getvalue() == ours


def test_metadata_is_that_of_jazzy(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "run") as writer:
        writer.add_topic("/state", UE_STATE, definition="uint8 x\n", type_hash="RIHS01_0")
        writer.write("/state", b"", 7)
        writer.write("/state", b"", 5)
    assert (tmp_path / "run" / "metadata.yaml").read_text() == METADATA


METADATA = """\
rosbag2_bagfile_information:
  version: 9
  storage_identifier: mcap
  duration:
    nanoseconds: 2
  starting_time:
    nanoseconds_since_epoch: 5
  message_count: 2
  topics_with_message_count:
    - topic_metadata:
        name: /state
        type: dopslam_msgs/msg/UeState
        serialization_format: cdr
        offered_qos_profiles: []
        type_description_hash: RIHS01_0
      message_count: 2
  compression_format: ""
  compression_mode: ""
  relative_file_paths:
    - run_0.mcap
  files:
    - path: run_0.mcap
      starting_time:
        nanoseconds_since_epoch: 5
      duration:
        nanoseconds: 2
      message_count: 2
  custom_data: ~
  ros_distro: jazzy
"""


def test_folder_contains_the_two_files_and_nothing_else(
    tmp_path: Path, samples: Any, write_bag: Any
) -> None:
    path = write_bag(tmp_path / "deep" / "down" / "my bag", samples)
    assert sorted(p.name for p in path.iterdir()) == ["metadata.yaml", "my bag_0.mcap"]


def test_equal_calls_make_equal_files(tmp_path: Path, samples: Any, write_bag: Any) -> None:
    one, two = (write_bag(tmp_path / name / "bag", samples) for name in ("one", "two"))
    for name in ("bag_0.mcap", "metadata.yaml"):
        assert (one / name).read_bytes() == (two / name).read_bytes()


@pytest.mark.parametrize("topics", [0, 1])
def test_empty_bag_is_a_bag(tmp_path: Path, topics: int) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        for _ in range(topics):
            writer.add_topic("/state", UE_STATE)
    with Reader(tmp_path / "bag") as reader:
        assert (reader.message_count, len(reader.connections)) == (0, topics)
    reader_of_ours = BagReader(tmp_path / "bag")
    assert list(reader_of_ours.messages()) == []
    assert reader_of_ours.damage is None
    assert reader_of_ours.start_time_ns is reader_of_ours.end_time_ns is None


def test_messages_larger_than_a_chunk(tmp_path: Path) -> None:
    payloads = [bytes([n]) * size for n, size in enumerate((1, 300_000, 4, 20, 100_000, 3))]
    with BagWriter(tmp_path / "bag", chunk_bytes=1000) as writer:
        writer.add_topic("/state", UE_STATE)
        for number, payload in enumerate(payloads):
            writer.write("/state", payload, number)
    assert [m.payload for m in BagReader(tmp_path / "bag").messages()] == payloads
    with Reader(tmp_path / "bag") as reader:
        assert [bytes(data) for _, _, data in reader.messages()] == payloads


@pytest.mark.parametrize("kind", ["folder", "file", "dangling link"])
def test_nothing_is_overwritten(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "bag"
    make: dict[str, Callable[[], object]] = {
        "folder": path.mkdir,
        "file": path.touch,
        "dangling link": lambda: path.symlink_to(tmp_path / "nowhere"),
    }
    make[kind]()
    with pytest.raises(BagExistsError, match=r"bag' exists already .* choose another name"):
        BagWriter(path)
    assert list(tmp_path.iterdir()) == [path]


def test_folder_that_cannot_be_created(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(BagWriteError, match="cannot be created"):
        BagWriter(tmp_path / "file" / "bag")


def test_topic_is_announced_once(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        for _ in range(3):
            writer.add_topic("/state", UE_STATE, qos=[OfferedQos()])
        with pytest.raises(BagWriteError, match=f"/state.*{UE_STATE}.*{ODOMETRY}"):
            writer.add_topic("/state", ODOMETRY)
        writer.write("/state", b"1", 1)
    with Reader(tmp_path / "bag") as reader:
        assert [(c.topic, c.msgtype) for c in reader.connections] == [("/state", UE_STATE)]


def test_types_nobody_knows_need_definition_and_hash(tmp_path: Path) -> None:
    qos = [OfferedQos(durability=Durability.TRANSIENT_LOCAL)]
    with BagWriter(tmp_path / "bag") as writer:
        with pytest.raises(BagTypeError, match="give its definition"):
            writer.add_topic("/odd", "odd_msgs/msg/Odd")
        writer.add_topic(
            "/odd", "odd_msgs/msg/Odd", qos=qos, definition="int8 a\n", type_hash="RIHS01_1"
        )
        writer.write("/odd", b"12345", 1)
    info = BagReader(tmp_path / "bag").topics["/odd"]
    assert (info.type_name, info.type_hash, info.definition) == (
        "odd_msgs/msg/Odd",
        "RIHS01_1",
        "int8 a\n",
    )
    assert (info.qos, info.message_count, info.encoding) == (tuple(qos), 1, "cdr")


def test_wrong_calls(tmp_path: Path) -> None:
    writer = BagWriter(tmp_path / "bag")
    writer.add_topic("/state", UE_STATE)
    with pytest.raises(BagWriteError, match=r"'/other'.*add_topic"):
        writer.write("/other", b"", 1)
    for log_ns, publish_ns in ((-1, None), (2**63, None), (1, -1), (1, 2**63)):
        with pytest.raises(BagWriteError, match="log time"):
            writer.write("/state", b"", log_ns, publish_ns)
    writer.write("/state", b"good", 1)
    writer.close()
    writer.close()
    for call in (
        lambda: writer.write("/state", b"", 1),
        lambda: writer.add_topic("/x", UE_STATE),
        writer.flush,
    ):
        with pytest.raises(BagWriteError, match="is closed"):
            call()
    assert [m.payload for m in BagReader(tmp_path / "bag").messages()] == [b"good"]


def test_error_in_the_recorder_leaves_a_whole_bag(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError), BagWriter(tmp_path / "bag") as writer:
        writer.add_topic("/state", UE_STATE)
        writer.write("/state", b"1", 1)
        raise ZeroDivisionError
    assert BagReader(tmp_path / "bag").damage is None


def test_flush_makes_everything_readable(tmp_path: Path) -> None:
    writer = BagWriter(tmp_path / "bag", flush_seconds=None)
    writer.add_topic("/state", UE_STATE)
    for number in range(5):
        writer.write("/state", b"x", number)
        writer.flush()
        writer.flush()
        assert BagReader(tmp_path / "bag").message_count == number + 1
    writer.close()


def test_old_chunks_are_finished_by_the_next_message(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag", flush_seconds=0.05, fsync_seconds=0.01) as writer:
        writer.add_topic("/state", UE_STATE)
        writer.write("/state", b"x", 1)
        time.sleep(0.06)
        writer.write("/state", b"x", 2)
        assert BagReader(tmp_path / "bag").message_count == 2


WRITING_CHILD = """
import os, sys, time
from pathlib import Path
from dopslam_ros.bag import BagWriter
path, period, size = Path(sys.argv[1]), float(sys.argv[2]), int(sys.argv[3])
writer = BagWriter(path)
writer.add_topic("/state", "dopslam_msgs/msg/UeState")
number = 0
while True:
    writer.write("/state", number.to_bytes(8, "little") + os.urandom(size), time.time_ns())
    os.write(1, b"%d %d\\n" % (number, time.time_ns()))
    number += 1
    if period:
        time.sleep(period)
"""


def _written_until_killed(path: Path, period: float, size: int, count: int) -> list[list[int]]:
    """Numbers and times [ns] of the messages a process wrote before it was killed."""
    command = [sys.executable, "-c", WRITING_CHILD, str(path), str(period), str(size)]
    environment = os.environ | {"PYTHONPATH": str(Path(dopslam_ros.__file__).parents[1])}
    with subprocess.Popen(command, stdout=subprocess.PIPE, env=environment) as child:
        assert child.stdout is not None
        lines = [child.stdout.readline() for _ in range(count)]
        child.kill()
        lines += child.stdout.readlines()
    return [[int(word) for word in line.split()] for line in lines if line.endswith(b"\n")]


@pytest.mark.parametrize(
    ("period", "size", "count", "most_lost"),
    [(0.4, 900, 8, 2), (0.02, 100, 100, 50), (0.0, 900, 20_000, 11)],
)
def test_kill_loses_less_than_a_second(
    tmp_path: Path, period: float, size: int, count: int, most_lost: int
) -> None:
    written = _written_until_killed(tmp_path / "bag", period, size, count)
    reader = BagReader(tmp_path / "bag")
    found = [int.from_bytes(m.payload[:8], "little") for m in reader.messages()]
    assert found == list(range(len(found)))
    assert len(found) >= len(written) - most_lost
    killed_ns = written[-1][1]
    assert all(killed_ns - time_ns < 1e9 for _, time_ns in written[len(found) :])
    assert reader.damage is not None
    assert f"breaks off after {len(found)} messages" in reader.damage
    assert not (tmp_path / "bag" / "metadata.yaml").exists()


LIMITED_CHILD = """
import os, resource, sys
from pathlib import Path
from dopslam_ros.bag import BagError, BagWriter
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]), int(sys.argv[2])))
writer = BagWriter(Path(sys.argv[1]), chunk_bytes=2000, flush_seconds=None)
writer.add_topic("/state", "dopslam_msgs/msg/UeState")
try:
    for number in range(100):
        writer.write("/state", number.to_bytes(8, "little") + os.urandom(900), number)
    print("write went well", end=" ")
    writer.close()
except BagError as error:
    print(error)
writer.close()
try:
    writer.write("/state", b"", 1)
except BagError as error:
    print(error)
"""


@pytest.mark.parametrize(("limit", "at_close"), [(20_000, False), (60_000, False), (98_000, True)])
def test_full_disk(tmp_path: Path, limit: int, at_close: bool) -> None:
    """The file may grow to the limit only: what is before it stays, and the error says so."""
    command = [sys.executable, "-c", LIMITED_CHILD, str(tmp_path / "bag"), str(limit)]
    environment = os.environ | {"PYTHONPATH": str(Path(dopslam_ros.__file__).parents[1])}
    done = subprocess.run(command, check=False, capture_output=True, text=True, env=environment)
    assert done.stderr == ""
    first, second = done.stdout.splitlines()
    assert first.startswith("write went well " * at_close + "writing bag")
    assert "File too large" in first
    assert "is closed" in second
    reader = BagReader(tmp_path / "bag")
    found = [int.from_bytes(m.payload[:8], "little") for m in reader.messages()]
    assert found == list(range(len(found)))
    assert len(found) >= (100 if at_close else limit // 1000 - 6)
    assert reader.damage is not None
    assert "with 0 bytes that cannot be read" in reader.damage
    assert [p.name for p in (tmp_path / "bag").iterdir()] == ["bag_0.mcap"]


def test_every_error_has_one_root() -> None:
    for kind in (BagExistsError, BagTypeError, BagWriteError):
        assert issubclass(kind, BagError)
