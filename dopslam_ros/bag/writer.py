"""Writing a bag so that a crash costs little: small chunks that reach the disk at once."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import IO, Any, cast

from mcap.well_known import MessageEncoding, Profile, SchemaEncoding
from mcap.writer import Writer

from dopslam_ros import __version__
from dopslam_ros.bag import metadata
from dopslam_ros.bag.errors import BagWriteError
from dopslam_ros.bag.file import create_file
from dopslam_ros.bag.qos import OfferedQos, to_yaml
from dopslam_ros.bag.reader import TopicInfo
from dopslam_ros.bag.typestore import definition as definition_of
from dopslam_ros.bag.typestore import type_hash as type_hash_of

_TIME_LIMIT_NS = 2**63
_IDL_START = "=" * 80 + "\nIDL: "


@dataclass
class _Topic:
    channel: int
    type_name: str
    type_hash: str
    qos: tuple[OfferedQos, ...]
    message_count: int = 0


class BagWriter:
    """Writes a rosbag2 bag: ``<bag>/<bag>_0.mcap`` and, at the end, ``<bag>/metadata.yaml``.

    What is in a finished chunk is with the operating system and survives the death of this
    process. A chunk is finished when it has ``chunk_bytes``, when ``flush_seconds`` have passed,
    which is looked at in ``write``, and by ``flush``: a recorder calls that twice a second, so that
    the messages before a pause are safe too.

    Not for use by several threads at once.
    """

    def __init__(
        self,
        path: Path,
        *,
        chunk_bytes: int = 8192,
        flush_seconds: float | None = 0.5,
        fsync_seconds: float | None = None,
    ) -> None:
        """Create the bag.

        Args:
            path: Folder of the bag; must not exist.
            chunk_bytes: Uncompressed size at which a chunk is finished. A message may be larger.
            flush_seconds: Age at which ``write`` finishes a chunk [s]; None: never, so that equal
                calls make equal files.
            fsync_seconds: Interval at which the disk is made to store everything [s], which
                matters when the power fails; a thread of its own waits for it. None: only when the
                bag is closed.

        Raises:
            BagExistsError: ``path`` exists.
            BagWriteError: The folder cannot be created.
        """
        self.path = Path(path)
        self._topics: dict[str, _Topic] = {}
        self._schemas: dict[tuple[str, str], int] = {}
        self._flush_seconds = flush_seconds
        self._flushed = time.monotonic()
        self._closed = False
        self._sink = create_file(self.path, fsync_seconds)
        self._span: tuple[int, int] | None = None  # of the log times [ns]
        self._mcap: Any = Writer(cast("IO[bytes]", self._sink), chunk_bytes)
        self._mcap.start(Profile.ROS2, f"dopslam_ros {__version__}")
        self.flush()

    @property
    def message_count(self) -> int:
        """Number of messages written so far."""
        return sum(topic.message_count for topic in self._topics.values())

    @property
    def closed(self) -> bool:
        """Whether nothing more can be written: after ``close``, or since the disk refused."""
        return self._closed

    def add_topic(
        self,
        topic: str,
        type_name: str,
        *,
        qos: Iterable[OfferedQos] = (),
        definition: str | None = None,
        type_hash: str | None = None,
    ) -> None:
        """Announce a topic. Doing so again with the same type changes nothing.

        Args:
            topic: Full name, such as ``/vehicle/odometry``.
            type_name: Such as ``nav_msgs/msg/Odometry``.
            qos: What the publishers offer.
            definition: Definition with all nested types, in the notation of .msg files; None: as
                installed.
            type_hash: ``RIHS01_...``; None: of the type as installed.

        Raises:
            BagTypeError: The type is unknown and definition or hash are not given.
            BagWriteError: The topic has another type, or the bag is closed.
        """
        self._check_open()
        known = self._topics.get(topic)
        if known is None:
            self._register(topic, type_name, tuple(qos), definition, type_hash)
        elif known.type_name != type_name:
            raise BagWriteError(
                f"topic '{topic}' of '{self.path}' has type {known.type_name} and cannot have "
                f"{type_name} as well: record one of the two under another name"
            )

    def copy_topic(self, topic: str, info: TopicInfo) -> None:
        """Announce a topic as it is described in another bag; see ``add_topic``."""
        self.add_topic(
            topic,
            info.type_name,
            qos=info.qos,
            definition=info.definition,
            type_hash=info.type_hash,
        )

    def write(
        self, topic: str, payload: bytes, log_time_ns: int, publish_time_ns: int | None = None
    ) -> None:
        """Append a message.

        Args:
            topic: A topic added before.
            payload: The message in CDR, encapsulation header included.
            log_time_ns: Time of reception [ns since the epoch of the clock in use].
            publish_time_ns: Time of sending [ns]; None: that of reception.

        Raises:
            BagWriteError: The topic was not added, a time is out of range, the bag is closed, or
                the disk refused; in the last case the messages before stay readable.
        """
        self._check_open()
        sent_ns = log_time_ns if publish_time_ns is None else publish_time_ns
        entry = self._topics.get(topic)
        if entry is None:
            raise BagWriteError(f"topic '{topic}' is not in '{self.path}': call add_topic first")
        if not (0 <= log_time_ns < _TIME_LIMIT_NS and 0 <= sent_ns < _TIME_LIMIT_NS):
            raise BagWriteError(
                f"a message on '{topic}' has log time {log_time_ns} ns and publish time {sent_ns} "
                "ns: both must be in [0, 2^63)"
            )
        self._mcap.add_message(entry.channel, log_time_ns, payload, sent_ns)
        entry.message_count += 1
        first, last = self._span or (log_time_ns, log_time_ns)
        self._span = min(first, log_time_ns), max(last, log_time_ns)
        if self._sink.pending:  # a chunk is full
            self._hand_on(self._sink.flush)
        elif self._flush_seconds is not None:
            if time.monotonic() - self._flushed >= self._flush_seconds:
                self.flush()

    def flush(self) -> None:
        """Finish the chunk in progress and hand everything to the operating system.

        Raises:
            BagWriteError: The disk refused; the messages before stay readable.
        """
        self._check_open()
        self._hand_on(self._mcap.flush)

    def close(self) -> None:
        """Write the index and ``metadata.yaml``. Closing again does nothing.

        Raises:
            BagWriteError: The disk refused; the messages stay readable.
        """
        if self._closed:
            return
        self._closed = True
        try:
            self._finish()
        except OSError as error:
            raise self._failure(error) from error
        finally:
            self._sink.close()

    def __enter__(self) -> BagWriter:
        """Return the writer itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Close the bag, after an error as well: what was written is valid."""
        self.close()

    def _register(
        self,
        topic: str,
        type_name: str,
        qos: tuple[OfferedQos, ...],
        definition: str | None,
        type_hash: str | None,
    ) -> None:
        text = definition_of(type_name) if definition is None else definition
        digest = type_hash_of(type_name) if type_hash is None else type_hash
        channel = self._mcap.register_channel(
            topic,
            MessageEncoding.CDR,
            self._schema(type_name, text),
            {"offered_qos_profiles": to_yaml(qos), "topic_type_hash": digest},
        )
        self._topics[topic] = _Topic(channel, type_name, digest, qos)

    def _schema(self, type_name: str, text: str) -> int:
        schema = self._schemas.get((type_name, text))
        if schema is None:
            idl = text.startswith(_IDL_START)
            encoding = SchemaEncoding.ROS2IDL if idl else SchemaEncoding.ROS2
            schema = self._mcap.register_schema(type_name, encoding, text.encode())
            self._schemas[type_name, text] = schema
        return schema

    def _hand_on(self, flush: Callable[[], None]) -> None:
        """Give the operating system what ``flush`` does."""
        self._flushed = time.monotonic()
        try:
            flush()
        except OSError as error:
            self._closed = True
            self._sink.close()
            raise self._failure(error) from error

    def _finish(self) -> None:
        self._mcap.flush()
        information = metadata.dump(
            metadata.Summary(
                self._sink.name, self._recorded_topics(), *(self._span or (None, None))
            )
        )
        self._mcap.add_metadata("rosbag2", {"serialized_metadata": information})
        self._mcap.finish()
        self._sink.flush()
        self._sink.sync()
        metadata.write(self.path, information)

    def _recorded_topics(self) -> dict[str, metadata.RecordedTopic]:
        return {
            name: metadata.RecordedTopic(t.type_name, t.type_hash, t.qos, t.message_count)
            for name, t in self._topics.items()
        }

    def _check_open(self) -> None:
        if self._closed:
            raise BagWriteError(f"bag '{self.path}' is closed: nothing more can be written to it")

    def _failure(self, error: OSError) -> BagWriteError:
        return BagWriteError(
            f"writing bag '{self.path}' failed ({error.strerror or error}): recording has ended, "
            "what was written before can be read; make room or check the disk, then start a new bag"
        )
