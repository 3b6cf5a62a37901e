"""Boards as messages come, live or from a bag."""

from __future__ import annotations

import time
from collections.abc import Generator
from pathlib import Path

from dopslam_ros.bag import BagReader
from dopslam_ros.cli.terminal.board import Board
from dopslam_ros.messages import topics
from dopslam_ros.system.errors import UsageError

# Between two pictures of a board [s].
FRAME_PERIOD = 0.2


def recorded(path: Path, namespace: str, rate: float) -> Generator[Board, None, None]:
    """The board of a bag as time goes by, some times as fast as recorded; infinity: at once.

    Raises:
        UsageError: there is no such vehicle in the bag.
        BagError: the bag cannot be read.
    """
    reader = BagReader(path)
    board = Board(_prefix(reader, namespace))
    begin, started = reader.start_time_ns or 0, time.monotonic()
    for message in reader.messages(set(board.names)):
        seconds = 1e-9 * (message.log_time_ns - begin)
        while (early := seconds / rate - (time.monotonic() - started)) > 0.0:
            yield board
            time.sleep(min(early, 0.5 * FRAME_PERIOD))
        board.take(message.topic, message.payload, seconds)
        yield board
    yield board


def _prefix(reader: BagReader, namespace: str) -> str:
    """The vehicle's, which need not be said where there is one alone."""
    found = topics.vehicle_prefixes(reader.topics)
    wanted = f"/{namespace.strip('/')}/".replace("//", "/")
    if not namespace and len(found) == 1:
        return found[0]
    if wanted not in found:
        have = ", ".join(prefix.rstrip("/") or "/" for prefix in found) or "none"
        raise UsageError(
            f"bag '{reader.path}' has no vehicle '{wanted.rstrip('/') or '/'}'; its vehicles:"
            f" {have} (--namespace)"
        )
    return wanted


def live(namespace: str) -> Generator[Board, None, None]:
    """The board of what is published now, for as long as somebody looks."""
    from dopslam_ros.nodes.listening import listening

    board = Board(f"/{namespace.strip('/')}/".replace("//", "/"))
    with listening(board.names, lambda n, p: board.take(n, p, time.monotonic())) as spin:
        while True:
            spin(0.2 * FRAME_PERIOD)
            yield board
