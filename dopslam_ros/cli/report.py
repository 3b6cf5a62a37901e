"""``dopslam report`` and ``dopslam compare``: runs as pages for the browser."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

from dopslam_ros.bag import BagReader
from dopslam_ros.cli.options import read_settings, with_progress, write_json
from dopslam_ros.core.pmb import FilterParameters
from dopslam_ros.lab.report.cases import parse_case, run_cases
from dopslam_ros.lab.report.compare_page import compare_page, comparison_cells, remarks
from dopslam_ros.lab.report.comparison import compare as compare_cases
from dopslam_ros.lab.report.page import plotting_library
from dopslam_ros.lab.report.recorded import last_reports
from dopslam_ros.lab.report.run_page import run_page
from dopslam_ros.lab.study.table import aligned
from dopslam_ros.offline.replay import replay
from dopslam_ros.simulation.warmup import warm_up_filter
from dopslam_ros.system.files import write_whole
from dopslam_ros.system.stopping import Stop


def report(options: Any) -> int:
    """Filters the bag and writes the page."""
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


def compare(options: Any) -> int:
    """Filters every bag, prints the tables and writes the page."""
    if options.out is not None:
        plotting_library()
    wanted = [parse_case(text) for text in options.cases]
    settings = read_settings(options)
    progress = partial(with_progress, total=None, description="replay")
    with Stop():
        warm_up_filter(FilterParameters())
        found = compare_cases(run_cases(wanted, settings, progress))
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
