"""What can be read of an MCAP file whose summary is missing, is damaged or says too little."""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, McapRecord, Message, Schema
from mcap.stream_reader import MAGIC_SIZE

from dopslam_ros.bag import chunks
from dopslam_ros.bag.chunks import Place
from dopslam_ros.bag.contents import Block, Contents, Kind

_PLAIN_BLOCK_BYTES = 2**20


class Scan:
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
        for place in chunks.places(self._stream, MAGIC_SIZE, self._size):
            try:
                self._look_at(place)
            except (chunks.DamagedError, *chunks.DAMAGE):
                self._broken_chunks += place.opcode == Opcode.CHUNK and not place.is_cut
            if not place.is_cut:
                self._end = place.offset + place.length
        self._note_problems()
        return self._contents

    def _look_at(self, place: Place) -> None:
        if place.opcode == Opcode.CHUNK:
            self._chunked |= not place.is_cut
            self._add_chunk(place)
        elif place.is_cut:
            return
        elif place.opcode == Opcode.MESSAGE and not self._chunked:
            self._add_plain_message(place)
        elif place.opcode == Opcode.SCHEMA and self._believes_declarations:
            self._declare(Schema.read(chunks.content_of(self._data_of(place))))
        elif place.opcode == Opcode.CHANNEL and self._believes_declarations:
            self._declare(Channel.read(chunks.content_of(self._data_of(place))))
        elif place.opcode == Opcode.DATA_END:
            self._data_ended = True

    @property
    def _believes_declarations(self) -> bool:
        """Whether types and topics outside the chunks are taken as they stand.

        Files with chunks declare them in there, under a checksum; those beside are repeated in the
        summary, and when its checksum is wrong a name in it may be too.
        """
        return self._summary_is_sound or not self._chunked

    def _data_of(self, place: Place) -> bytes:
        return chunks.read_part(self._stream, place.offset, place.length)

    def _declare(self, record: McapRecord) -> None:
        """Note the type or topic that a record declares; other records are ignored."""
        if isinstance(record, Schema):
            self._contents.schemas.setdefault(record.id, record)
        elif isinstance(record, Channel):
            self._contents.channels.setdefault(record.id, record)

    def _add_chunk(self, place: Place) -> None:
        kind = Kind.CUT_CHUNK if place.is_cut else Kind.CHUNK
        block = Block(kind, place.offset, place.length, 0, 0, set())
        found = chunks.load_block(self._stream, block)
        for record in found:
            self._declare(record)
        messages = [record for record in found if isinstance(record, Message)]
        if messages:
            self._contents.counts.update(message.channel_id for message in messages)
            block.start_ns = min(message.log_time for message in messages)
            block.end_ns = max(message.log_time for message in messages)
            block.channels = {message.channel_id for message in messages}
            self._contents.blocks.append(block)

    def _add_plain_message(self, place: Place) -> None:
        """Add a message outside a chunk to the block before it, or start a block with it."""
        if place.length < chunks.MESSAGE_BYTES:
            raise ValueError(f"a message of {place.length} bytes")
        self._stream.seek(place.offset + chunks.RECORD_HEADER.size)
        message = Message.read(ReadDataStream(self._stream), chunks.MESSAGE_HEADER_BYTES)
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
