"""``dopslam figures``: a study beside the paper."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from dopslam_ros.cli.options import add_json, write_json

TEXT = "draw a study beside the paper's figures, with their ratios"
EXAMPLE = "dopslam figures runs/study --out runs/figures"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of the command."""
    parser.add_argument("study", type=Path, help="folder of a study")
    parser.add_argument("--out", type=Path, required=True, help="folder of the pictures and tables")
    add_json(parser)


def run(options: Any) -> int:
    """Draws what the study has, and says what it has not."""
    from dopslam_ros.lab.figures.paper import draw_study, missing
    from dopslam_ros.lab.figures.ratios import write_ratios
    from dopslam_ros.lab.study.results import load_results

    results = load_results(options.study)
    options.out.mkdir(parents=True, exist_ok=True)
    names = draw_study(results, options.out)
    write_json(options.json, write_ratios(results, options.out))
    print(f"in {options.out}: {', '.join(names)} (.png, .svg); ratios (.md, .csv, .json)")
    for text in missing(results):
        print(f"missing: {text}")
    return 0
