"""``dopslam bench``: speed and memory."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from dopslam_ros.cli.options import add_json, add_list
from dopslam_ros.lab.bench.titles import TITLES

TEXT = "measure speed and memory, beside what they compare with"
EXAMPLE = "dopslam bench --json bench.json --markdown BENCHMARKS.md"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``dopslam bench``."""
    parser.add_argument(
        "--only", nargs="+", metavar="NAME", help="these benchmarks alone (default: all)"
    )
    parser.add_argument(
        "--quick", action="store_true", help="few repetitions: rough figures within minutes"
    )
    parser.add_argument(
        "--from",
        dest="source",
        type=Path,
        metavar="F",
        help="measure nothing, show what --json wrote into this file",
    )
    parser.add_argument(
        "--markdown", type=Path, metavar="F", help="file for the result as a document"
    )
    add_json(parser)
    add_list(parser, "benchmarks", TITLES)


def run(options: Any) -> int:
    """Does it."""
    from dopslam_ros.cli.bench import run as work

    return work(options)
