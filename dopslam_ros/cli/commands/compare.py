"""``dopslam compare``: runs beside each other."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from dopslam_ros.cli.options import add_json, add_settings

TEXT = "runs, or one run set in several ways, in numbers"
EXAMPLE = "dopslam compare bags/paper bags/paper:doppler=none --out doppler.html"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of the command."""
    parser.add_argument(
        "cases",
        nargs="+",
        metavar="CASE",
        help="[NAME=]BAG[:SETTING=VALUE,...]; the others are compared with the first",
    )
    parser.add_argument("--out", type=Path, metavar="F", help="a page (.html) with the curves")
    add_settings(parser)
    add_json(parser)
    parser.epilog = f"""\
BAG is a bag, or a folder of bags: a run each. It is filtered as it was recorded, or with
settings of its own: parameters of the filter, and doppler=M/S or doppler=none. What has
the same NAME are runs of one case.

{parser.epilog}
  dopslam compare joint=runs/sims paper=runs/sims:coupling=marginal"""


def run(options: Any) -> int:
    """Does it."""
    from dopslam_ros.cli.report import compare as work

    return work(options)
