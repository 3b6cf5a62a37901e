"""``dopslam compare``: runs beside each other."""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path
from typing import Any

from dopslam_ros.cli.options import add_json, add_settings, read_settings, write_json
from dopslam_ros.cli.progress import with_progress
from dopslam_ros.system.files import write_whole
from dopslam_ros.system.stopping import Stop

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
    """Filters every bag, prints the tables and writes the page."""
    from dopslam_ros.core.pmb import FilterParameters
    from dopslam_ros.lab.report.cases import parse_case, run_cases
    from dopslam_ros.lab.report.compare_page import compare_page, comparison_cells, remarks
    from dopslam_ros.lab.report.comparison import compare
    from dopslam_ros.lab.report.page import plotting_library
    from dopslam_ros.lab.study.table import aligned
    from dopslam_ros.simulation.warmup import warm_up_filter

    if options.out is not None:
        plotting_library()
    wanted = [parse_case(text) for text in options.cases]
    settings = read_settings(options)
    progress = partial(with_progress, total=None, description="replay")
    with Stop():
        warm_up_filter(FilterParameters())
        found = compare(run_cases(wanted, settings, progress))
    for text in remarks(found.summary):
        print(text)
    for title, cells in comparison_cells(found.summary):
        print("" if not title else f"\n{title}")
        for text in aligned(cells):
            print(text)
    write_json(options.json, found.summary)
    if options.out is not None:
        write_whole(options.out, compare_page(found).encode("utf-8"))
        print(f"\nopen {options.out} in a browser")
    return 0
