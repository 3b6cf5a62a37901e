"""``dopslam map``: what is in a saved map or snapshot."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from dopslam_ros.cli.options import add_json

TEXT = "what is in a saved map or snapshot"
EXAMPLE = "dopslam map ~/.ros/dopslam/hall.dopmap"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of the command."""
    parser.add_argument("file", type=Path, help="a file that save_map, replay or a filter left")
    add_json(parser)


def run(options: Any) -> int:
    """Does it."""
    from dopslam_ros.cli.saved_map import run as work

    return work(options)
