"""What is in one MCAP file: its types, its topics, and where their messages are."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path

from mcap.records import Channel, Schema


class Kind(Enum):
    """How the messages of a block are stored."""

    CHUNK = "in a chunk"
    CUT_CHUNK = "in a chunk whose end is missing"
    PLAIN = "as records of the file"


@dataclass
class Block:
    """A part of a file that is read at once.

    Attributes:
        kind: How its messages are stored.
        offset: Where it is in the file [bytes].
        length: How long it is [bytes].
        start_ns: Earliest log time in it [ns].
        end_ns: Latest log time in it [ns].
        channels: Numbers of the channels in it; empty: not known.
    """

    kind: Kind
    offset: int
    length: int
    start_ns: int
    end_ns: int
    channels: set[int]


@dataclass
class Contents:
    """What is in a file.

    Attributes:
        path: The file.
        schemas: Message types by number.
        channels: Topics by number.
        blocks: Where the messages are, in the order of the file.
        counts: Number of messages by channel.
        problems: What is wrong with the file, in parts of a sentence.
    """

    path: Path
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    blocks: list[Block] = field(default_factory=list)
    counts: Counter[int] = field(default_factory=Counter)
    problems: list[str] = field(default_factory=list)

    def type_name(self, channel: Channel) -> str:
        """Type of a channel's messages; empty when it has none."""
        schema = self.schemas.get(channel.schema_id)
        return "" if schema is None else schema.name
