"""``dopslam watch``: a run in the terminal."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from dopslam_ros.cli.options import add_json, positive_number

TEXT = "pose, map, rates and health in the terminal, live or a bag's"
EXAMPLE = "dopslam watch bags/paper --rate 5"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``dopslam watch``."""
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


def run(options: Any) -> int:
    """Does it."""
    from dopslam_ros.cli.watch import run as work

    return work(options)
