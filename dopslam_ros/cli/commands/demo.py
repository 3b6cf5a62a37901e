"""``dopslam demo``: the whole of it, live."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from dopslam_ros.cli.options import (
    add_json,
    add_scenario,
    add_seed,
    positive_number,
    write_json,
)
from dopslam_ros.cli.progress import progress_bar
from dopslam_ros.cli.run_summary import print_summary
from dopslam_ros.system.files import write_whole
from dopslam_ros.system.stopping import Stop

TEXT = "run the paper's scene live, record, replay, compare, draw"
EXAMPLE = "dopslam demo --rate 5"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of the command."""
    add_scenario(parser, "paper")
    add_seed(parser)
    parser.add_argument(
        "--rate", type=positive_number, default=10.0, help="times real time (default: 10)"
    )
    parser.add_argument(
        "--out", type=Path, default=Path("runs"), help="parent folder of the results"
    )
    add_json(parser)


def run(options: Any) -> int:
    """Runs it; returns 1 if the replay is not what was recorded."""
    from dopslam_ros.lab.demo.live_run import new_folder, run_live
    from dopslam_ros.simulation.scenario import load_scenario

    scenario = load_scenario(options.scenario)
    seed = scenario.seed if options.seed is None else options.seed
    folder = new_folder(options.out, scenario)
    print(f"scene '{scenario.name}', seed {seed}, {options.rate:g} times real time -> {folder}")
    with progress_bar(scenario.steps, "live") as show:
        bag = run_live(options.scenario, seed, options.rate, folder, show)
    with Stop():
        return _replayed(bag, folder, f"{scenario.name}, seed {seed}", options.json)


def _replayed(bag: Path, folder: Path, title: str, file: Path | None) -> int:
    """What follows the live run."""
    from dopslam_ros.bag import BagReader
    from dopslam_ros.lab.demo.comparison import replay_and_compare
    from dopslam_ros.lab.figures.run import draw_run
    from dopslam_ros.lab.report.recorded import last_reports
    from dopslam_ros.lab.report.run_page import run_page

    replayed, different = replay_and_compare(bag, folder / "replay")
    summary = replayed.summary()
    write_json(folder / "result.json", summary)
    write_json(file, summary)
    print(f"live run recorded in {bag}, replayed into {folder / 'replay'}")
    print(f"replay against live: {different or 'all vehicle states equal, byte for byte'}")
    print_summary(summary)
    picture = folder / "run.png"
    draw_run(replayed, picture, title)
    print(f"picture: {picture}")
    page = folder / "report.html"
    text = run_page(replayed, title, bag.resolve(), last_reports(BagReader(bag)))
    write_whole(page, text.encode("utf-8"))
    print(f"the map over time: open {page} in a browser")
    return 1 if different else 0
