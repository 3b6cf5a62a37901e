"""``dopslam report``: a run as a page."""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path
from typing import Any

from dopslam_ros.cli.options import add_json, add_settings, read_settings, write_json
from dopslam_ros.cli.progress import with_progress
from dopslam_ros.system.files import write_whole
from dopslam_ros.system.stopping import Stop

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
    """Filters the bag and writes the page."""
    from dopslam_ros.bag import BagReader
    from dopslam_ros.core.pmb import FilterParameters
    from dopslam_ros.lab.report.page import plotting_library
    from dopslam_ros.lab.report.recorded import last_reports
    from dopslam_ros.lab.report.run_page import run_page
    from dopslam_ros.offline.replay import replay
    from dopslam_ros.simulation.warmup import warm_up_filter

    plotting_library()  # missing, it is better told now than after the work
    reader = BagReader(options.bag)
    settings = read_settings(options)
    progress = partial(with_progress, total=None, description="replay")
    bag = options.bag.resolve()
    out = options.out or Path(f"{bag.stem}.html")
    with Stop():
        warm_up_filter(FilterParameters())  # times of steps are not to be those of a compiler
        run = replay(reader, settings, None, progress)
        text = run_page(run, bag.stem if bag.is_file() else bag.name, bag, last_reports(reader))
    write_whole(out, text.encode("utf-8"))
    write_json(options.json, run.summary())
    print(f"{len(run.outputs)} steps of {options.bag}: open {out} in a browser")
    if run.damage:
        print(f"damaged bag: {run.damage}")
    return 0
