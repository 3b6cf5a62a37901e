"""``dopslam simulate``: a run without middleware."""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path
from typing import Any

from dopslam_ros.cli.options import add_json, add_scenario, add_seed, write_json
from dopslam_ros.cli.progress import with_progress
from dopslam_ros.system.stopping import Stop

TEXT = "write a simulated run into a bag"
EXAMPLE = "dopslam simulate --scenario paper --seed 7 --out runs/sim7"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of the command."""
    add_scenario(parser, "paper")
    add_seed(parser)
    parser.add_argument("--out", type=Path, required=True, help="folder of the new bag")
    add_json(parser)


def run(options: Any) -> int:
    """Simulates until the scene ends or Ctrl-C comes."""
    from dopslam_ros.bag import BagWriter
    from dopslam_ros.simulation.recording import write_simulation
    from dopslam_ros.simulation.scenario import load_scenario

    scenario = load_scenario(options.scenario)
    seed = scenario.seed if options.seed is None else options.seed
    progress = partial(with_progress, total=scenario.steps, description="simulate")
    with Stop(keep=True) as stop, BagWriter(options.out, flush_seconds=None) as writer:
        count = write_simulation(scenario, seed, writer, progress)
    content = {"scenario": scenario.name, "seed": seed, "snapshots": count}
    write_json(options.json, {**content, "bag": str(options.out), "stopped": stop.asked})
    print(f"{count} snapshots of scene '{scenario.name}', seed {seed}, in {options.out}")
    return stop.code()
