"""``dopslam trouble``: a vehicle gets lost, and is it found again."""

from __future__ import annotations

import argparse
from typing import Any

from dopslam_ros.cli.options import add_json, add_list, add_runs, add_scenario
from dopslam_ros.lab.study.names import TROUBLES

TEXT = "Monte Carlo: a vehicle gets lost, and is it found again"
EXAMPLE = "dopslam trouble --runs 200 --seed 12345 --json trouble.json"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of the command."""
    add_scenario(parser, "paper")
    parser.add_argument(
        "--kinds", nargs="+", choices=list(TROUBLES), default=list(TROUBLES), help="default: all"
    )
    add_runs(parser, 200)
    add_json(parser)
    add_list(parser, "kinds of trouble", TROUBLES)


def run(options: Any) -> int:
    """Does it."""
    from dopslam_ros.cli.failure_injection import run as work

    return work(options)
