"""``dopslam report``: a run as a page for the browser."""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path
from typing import Any

from dopslam_ros.bag import BagReader
from dopslam_ros.core.filter import FilterParameters
from dopslam_ros.core.warmup import warm_up_filter
from dopslam_ros.files import write_whole
from dopslam_ros.options import add_settings, read_settings, with_progress
from dopslam_ros.replay import replay
from dopslam_ros.report.page import plotting_library
from dopslam_ros.report.recorded import last_reports
from dopslam_ros.report.run_page import run_page


def add_report_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of the command."""
    parser.add_argument("bag", type=Path, help="folder of a bag, or an .mcap file")
    parser.add_argument(
        "--out", type=Path, metavar="F", help="the page (default: the bag's name with .html)"
    )
    add_settings(parser)


def report(options: Any) -> int:
    """Filters the bag and writes the page."""
    plotting_library()  # missing, it is better told now than after the work
    reader = BagReader(options.bag)
    settings = read_settings(options)
    warm_up_filter(FilterParameters())  # times of steps are not to be those of a compiler
    run = replay(reader, settings, None, partial(with_progress, total=None, description="replay"))
    out = options.out or Path(f"{options.bag.resolve().stem}.html")
    write_whole(out, run_page(run, str(options.bag), last_reports(reader)).encode("utf-8"))
    print(f"{len(run.outputs)} steps of {options.bag}: open {out} in a browser")
    if run.damage:
        print(f"damaged bag: {run.damage}")
    return 0
