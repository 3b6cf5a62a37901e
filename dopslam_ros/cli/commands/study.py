"""``dopslam study``: filters beside each other, and their bound."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from dopslam_ros.cli.options import (
    add_json,
    add_list,
    add_runs,
    add_scenario,
    add_settings,
    positive_number,
    whole_from_one,
)
from dopslam_ros.lab.study.names import FILTERS

TEXT = "Monte Carlo: filters beside each other and their bound"
EXAMPLE = "dopslam study --filters joint marginal --doppler 0.1 none --out runs/study"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``dopslam study``."""
    add_scenario(parser, "paper")
    parser.add_argument(
        "--filters",
        nargs="+",
        default=["joint"],
        metavar="FILTER",
        help=f"{', '.join(FILTERS)}; also with settings of its own, as"
        " joint:gamma=20,prune_type=0.01 (default: joint); the others are compared with the first",
    )
    parser.add_argument(
        "--doppler",
        nargs="+",
        type=_doppler,
        metavar="M/S",
        help="standard deviations of the Doppler [m/s], none for without (default: the scene's)",
    )
    add_runs(parser, 100)
    parser.add_argument(
        "--out", type=Path, help="folder of the study; if it is there already, to go on with"
    )
    parser.add_argument("--workers", type=whole_from_one, help="processes (default: one a core)")
    parser.add_argument(
        "--scheduler", metavar="ADDRESS", help="compute on this Dask cluster: tcp://host:port"
    )
    add_settings(parser)
    add_json(parser)
    add_list(parser, "filters", FILTERS)


def run(options: Any) -> int:
    """Does it."""
    from dopslam_ros.cli.study import run as work

    return work(options)


def _doppler(text: str) -> float | None:
    return None if text == "none" else positive_number(text)
