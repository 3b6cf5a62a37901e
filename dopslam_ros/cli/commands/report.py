"""``dopslam report``: a run as a page."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from dopslam_ros.cli.options import add_json, add_settings

TEXT = "a run as one page for the browser, map over time"
EXAMPLE = "dopslam report bags/paper --out paper.html"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of the command."""
    parser.add_argument("bag", type=Path, help="folder of a bag, or an .mcap file")
    parser.add_argument(
        "--out", type=Path, metavar="F", help="the page (default: the bag's name with .html)"
    )
    add_settings(parser)
    add_json(parser)


def run(options: Any) -> int:
    """Does it."""
    from dopslam_ros.cli.report import report as work

    return work(options)
