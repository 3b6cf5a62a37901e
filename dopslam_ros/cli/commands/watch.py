"""``dopslam watch``: a run in the terminal."""

from __future__ import annotations

import argparse
import contextlib
import math
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dopslam_ros.cli.options import add_json, positive_number, write_json

if TYPE_CHECKING:
    from rich.console import Console

    from dopslam_ros.cli.terminal.board import Board

TEXT = "pose, map, rates and health in the terminal, live or a bag's"
EXAMPLE = "dopslam watch bags/paper --rate 5"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of the command."""
    parser.add_argument("bag", type=Path, nargs="?", help="a recorded run (default: the live one)")
    parser.add_argument("--namespace", default="", metavar="NS", help="of the vehicle, as /car1")
    parser.add_argument(
        "--rate", type=positive_number, default=1.0, help="times as fast as recorded (default: 1)"
    )
    parser.add_argument("--once", action="store_true", help="one frame: the end of a bag, or now")
    parser.add_argument(
        "--patience",
        type=positive_number,
        default=10.0,
        metavar="S",
        help="seconds that --once waits for a live state (default: 10)",
    )
    add_json(parser)


def run(options: Any, console: Console | None = None) -> int:
    """Watches; returns 1 if --once saw no state.

    Raises:
        UsageError: there is no such vehicle in the bag.
        BagError: the bag cannot be read.
    """
    from rich.console import Console

    from dopslam_ros.cli.terminal.feed import live, recorded

    console = console or Console()
    if options.bag is not None:
        feed = recorded(options.bag, options.namespace, math.inf if options.once else options.rate)
    else:
        feed = live(options.namespace)
    with contextlib.closing(feed):
        return _once(feed, options, console) if options.once else _follow(feed, options, console)


def _once(feed: Iterator[Board], options: Any, console: Console) -> int:
    from dopslam_ros.cli.terminal.frame import frame
    from dopslam_ros.messages import topics

    end = time.monotonic() + options.patience
    board: Board | None = None
    for board in feed:
        enough = topics.UE_STATE.name in board.last and bool(board.health)
        if options.bag is None and (enough or time.monotonic() > end):
            break
    if board is not None:
        console.print(frame(board))
        write_json(options.json, board.content())
    return 0 if board is not None and topics.UE_STATE.name in board.last else 1


def _follow(feed: Iterator[Board], options: Any, console: Console) -> int:
    """Draws until the feed ends; where there is no terminal, the last frame alone."""
    from rich.live import Live

    from dopslam_ros.cli.terminal.feed import FRAME_PERIOD
    from dopslam_ros.cli.terminal.frame import frame

    board: Board | None = None
    try:
        with Live(console=console, auto_refresh=False, vertical_overflow="visible") as screen:
            drawn = -math.inf
            for board in feed:
                now = time.monotonic()
                if now - drawn >= FRAME_PERIOD:
                    drawn = now
                    screen.update(frame(board), refresh=console.is_terminal)
            if board is not None:
                screen.update(frame(board), refresh=True)
    finally:  # a live run is watched until Ctrl-C
        if board is not None:
            write_json(options.json, board.content())
    return 0
