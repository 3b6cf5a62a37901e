"""``dopslam bounds``: what no estimator can beat."""

from __future__ import annotations

import argparse
import math
from typing import Any

from dopslam_ros.cli.options import add_json, add_scenario, positive_number, write_json
from dopslam_ros.system.stopping import Stop, until_stopped

TEXT = "error bounds at the last step, for several Doppler noises"
EXAMPLE = "dopslam bounds --sigma-d 0.1 0.5"

SIGMAS = (0.05, 0.1, 0.2, 0.3, 0.4, 0.5)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of the command."""
    add_scenario(parser, "paper_bounds")
    parser.add_argument(
        "--sigma-d",
        type=positive_number,
        nargs="+",
        default=SIGMAS,
        metavar="M/S",
        help="standard deviations of the Doppler [m/s]; without Doppler is always added",
    )
    add_json(parser)


def run(options: Any) -> int:
    """Computes them, and prints them beside the paper's."""
    from dopslam_ros.core.settings.model import with_doppler_std
    from dopslam_ros.lab.published import published
    from dopslam_ros.simulation.matched import nominal_bounds
    from dopslam_ros.simulation.scenario import load_scenario

    scenario = load_scenario(options.scenario)
    rows = []
    with Stop(keep=True) as stop:
        for sigma in until_stopped((*options.sigma_d, None)):
            bound = nominal_bounds(with_doppler_std(scenario, sigma))
            rows.append(
                {
                    "sigma_d": sigma,
                    "peb": bound.peb,
                    "heb_deg": math.degrees(bound.heb),
                    "ceb": bound.ceb,
                    "leb_mean": float(bound.leb.mean()) if len(bound.leb) else math.nan,
                }
            )
    write_json(options.json, {"rows": rows})
    print("bounds at the last step; in brackets, ours over the paper's")
    print(f"{'sigma_d':>9} {'PEB [m]':>16} {'HEB [deg]':>16} {'CEB [m]':>16} {'mean LEB [m]':>16}")
    for row in rows:
        sigma = row["sigma_d"]
        theirs = published().bounds_at(sigma) if scenario.name == "paper_bounds" else None
        cells = [row[key] for key in ("peb", "heb_deg", "ceb", "leb_mean")]
        texts = [
            f"{ours:.4f}" + ("" if theirs is None else f" ({ours / theirs[n]:.3f})")
            for n, ours in enumerate(cells)
        ]
        name = "without" if sigma is None else f"{sigma:g} m/s"
        print(f"{name:>9} " + " ".join(f"{text:>16}" for text in texts))
    return stop.code()
