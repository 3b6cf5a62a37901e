"""Reading a bag, whole or damaged, in the order of its log times."""

from __future__ import annotations

import re
import shlex
from bisect import bisect_left
from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO, NamedTuple, TypeAlias

from mcap.records import Channel, McapRecord, Message

from dopslam_ros.bag import metadata
from dopslam_ros.bag.chunks import DamagedError, load_block
from dopslam_ros.bag.contents import Block, Contents
from dopslam_ros.bag.errors import BagError, BagFormatError
from dopslam_ros.bag.opening import read_contents
from dopslam_ros.bag.qos import OfferedQos, from_yaml


@dataclass(frozen=True)
class TopicInfo:
    """What a bag says about one of its topics.

    Attributes:
        type_name: Such as ``nav_msgs/msg/Odometry``.
        qos: What its publishers offered; empty when that was not recorded.
        message_count: Number of its messages.
        type_hash: ``RIHS01_...``, or empty when that was not recorded.
        definition: Definition of the type with all nested types.
        encoding: Encoding of its messages; ``cdr`` in bags of ROS 2.
    """

    type_name: str
    qos: tuple[OfferedQos, ...]
    message_count: int
    type_hash: str
    definition: str
    encoding: str


class BagMessage(NamedTuple):
    """A message as recorded.

    Attributes:
        topic: Its topic.
        type_name: Such as ``nav_msgs/msg/Odometry``.
        log_time_ns: When it was received [ns].
        publish_time_ns: When it was sent [ns].
        payload: The message in CDR, encapsulation header included.
    """

    topic: str
    type_name: str
    log_time_ns: int
    publish_time_ns: int
    payload: bytes


class BagReader:
    """Reads a bag: its folder, or one of its files.

    No file stays open between two calls, so that there is nothing to close. Of a damaged bag
    everything that can be read is delivered, and ``damage`` says what is missing.

    Attributes:
        path: What was opened.
        topics: What there is, by topic.
    """

    def __init__(self, path: Path) -> None:
        """Find out what is in the bag.

        Args:
            path: Folder of a bag, or an MCAP file.

        Raises:
            BagFormatError: There is no bag, or one that cannot be read.
            BagError: The disk refused.
        """
        self.path = Path(path)
        self._problems: list[str] = []
        try:
            paths = self._paths()
            self._files = [read_contents(file) for file in paths]
        except OSError as error:
            raise _unreadable(self.path, error) from error
        for contents in self._files:
            self._problems += contents.problems
        self.topics = _topics(self._files)

    @property
    def damage(self) -> str | None:
        """What is missing, in one sentence; None: nothing.

        A file with a sound index is believed until its messages are read: of damage inside such a
        file, this tells after ``messages`` has passed it.
        """
        if not self._problems:
            return None
        source = shlex.quote(str(self.path))
        remedy = f"run dopslam recover {source} to save the rest"
        return f"{', and '.join(self._problems)}: {remedy}"

    @property
    def message_count(self) -> int:
        """Number of messages on all topics."""
        return sum(info.message_count for info in self.topics.values())

    @property
    def start_time_ns(self) -> int | None:
        """Log time of the first message [ns]; None: there is none."""
        return min((b.start_ns for f in self._files for b in f.blocks), default=None)

    @property
    def end_time_ns(self) -> int | None:
        """Log time of the last message [ns]; None: there is none."""
        return max((b.end_ns for f in self._files for b in f.blocks), default=None)

    def messages(self, topics: Collection[str] | None = None) -> Iterator[BagMessage]:
        """Read the messages in the order of their log times, then of their places in the files.

        Args:
            topics: Topics wanted; None: all. One that is not in the bag delivers nothing.

        Raises:
            BagError: The disk refused.
        """
        wanted = {topics} if isinstance(topics, str) else topics
        try:
            yield from self._in_order(_parts(self._files, wanted))
        except OSError as error:
            raise _unreadable(self.path, error) from error

    def _in_order(self, parts: list[_Part]) -> Iterator[BagMessage]:
        """Merge parts that may overlap in time; only those that do are in memory together."""
        held: list[_Row] = []
        with _Stream() as stream:
            for part in sorted(parts, key=lambda p: (p.block.start_ns, p.rank)):
                ready = bisect_left(held, (part.block.start_ns, part.rank))
                yield from (row[3] for row in held[:ready])
                held = sorted(held[ready:] + self._rows(part, stream))
            yield from (row[3] for row in held)

    def _rows(self, part: _Part, stream: _Stream) -> list[_Row]:
        """Read a part; when it is damaged, note that and go on without it."""
        try:
            return _rows(part, load_block(stream.of(part.path), part.block))
        except DamagedError as error:
            place = f"{error} at byte {part.block.offset} of '{part.path}' is left out"
            if place not in self._problems:
                self._problems.append(place)
            return []

    def _paths(self) -> list[Path]:
        """Files of the bag in the order in which they were recorded."""
        if self.path.is_file():
            return [self.path]
        if not self.path.is_dir():
            raise BagFormatError(
                f"there is no bag at '{self.path}': give the folder of a bag or an MCAP file"
            )
        listed = self._listed_paths()
        paths = [path for path in listed if path.is_file()]
        missing = [path.name for path in listed if not path.is_file()]
        if missing and paths:
            self._problems.append(f"file(s) {', '.join(missing)} of '{self.path}' are missing")
        paths = paths or sorted(self.path.glob("*.mcap"), key=_natural)
        if not paths:
            raise BagFormatError(_no_mcap(self.path))
        return paths

    def _listed_paths(self) -> list[Path]:
        try:
            names = metadata.listed_files(self.path) or []
        except BagFormatError as error:
            self._problems.append(str(error))
            names = []
        return [self.path / name for name in names if name.endswith(".mcap")]


_Row: TypeAlias = tuple[int, int, int, BagMessage]
"""Log time [ns], rank of the part, place in it, and the message: sorts without looking at it."""

_Names: TypeAlias = dict[int, tuple[str, str]]
"""Topic and type by number of channel."""


class _Part(NamedTuple):
    """A block to be read, and what is needed for that."""

    rank: int
    path: Path
    block: Block
    names: _Names


class _Stream:
    """One open file, the one that was asked for last."""

    def __init__(self) -> None:
        self._path: Path | None = None
        self._stream: BinaryIO | None = None

    def of(self, path: Path) -> BinaryIO:
        """The file at ``path``."""
        if self._stream is None or path != self._path:
            self.__exit__()
            self._path, self._stream = path, path.open("rb")
        return self._stream

    def __enter__(self) -> _Stream:
        return self

    def __exit__(self, *_: object) -> None:
        if self._stream is not None:
            self._stream.close()


def _parts(files: list[Contents], wanted: Collection[str] | None) -> list[_Part]:
    parts: list[_Part] = []
    for contents in files:
        names = {
            number: (channel.topic, contents.type_name(channel))
            for number, channel in contents.channels.items()
            if wanted is None or channel.topic in wanted
        }
        for block in contents.blocks:
            if not block.channels or not block.channels.isdisjoint(names):
                parts.append(_Part(len(parts), contents.path, block, names))
    return parts


def _rows(part: _Part, records: list[McapRecord]) -> list[_Row]:
    """Messages of a part on the topics that are wanted."""
    rows: list[_Row] = []
    for record in records:
        if isinstance(record, Message) and (name := part.names.get(record.channel_id)):
            message = BagMessage(*name, record.log_time, record.publish_time, record.data)
            rows.append((record.log_time, part.rank, len(rows), message))
    return rows


def _topics(files: list[Contents]) -> dict[str, TopicInfo]:
    """Topics of all files; what the first file with a topic says about it is taken."""
    topics: dict[str, TopicInfo] = {}
    for contents in files:
        for number, channel in sorted(contents.channels.items()):
            count = contents.counts[number]
            known = topics.get(channel.topic) or _topic_info(contents, channel)
            topics[channel.topic] = replace(known, message_count=known.message_count + count)
    return topics


def _topic_info(contents: Contents, channel: Channel) -> TopicInfo:
    schema = contents.schemas.get(channel.schema_id)
    return TopicInfo(
        type_name=contents.type_name(channel),
        qos=_qos(channel),
        message_count=0,
        type_hash=channel.metadata.get("topic_type_hash", ""),
        definition="" if schema is None else schema.data.decode(errors="replace"),
        encoding=channel.message_encoding,
    )


def _qos(channel: Channel) -> tuple[OfferedQos, ...]:
    try:
        return from_yaml(channel.metadata.get("offered_qos_profiles", ""))
    except BagFormatError:
        return ()


def _natural(path: Path) -> list[tuple[int, str]]:
    """Key that sorts ``bag_10`` behind ``bag_9``."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in _DIGITS.split(path.name)]


_DIGITS = re.compile(r"(\d+)")


def _no_mcap(folder: Path) -> str:
    if any(folder.glob("*.db3")):
        return (
            f"bag '{folder}' is stored in SQLite, only MCAP can be read: convert it with "
            "'ros2 bag convert'"
        )
    if any(folder.glob("*.mcap.zstd")):
        return f"the files of bag '{folder}' are compressed as a whole: unpack them with 'unzstd'"
    return f"there is no .mcap file in '{folder}': give the folder of a bag or an MCAP file"


def _unreadable(path: Path, error: OSError) -> BagError:
    return BagError(f"bag '{path}' cannot be read: {error}")
