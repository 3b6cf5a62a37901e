"""``dopslam inject``: a vehicle gets lost, and is it found again."""

from __future__ import annotations

import argparse
import itertools
from typing import TYPE_CHECKING, Any

from dopslam_ros.cli.options import add_json, add_list, add_runs, add_scenario, write_json
from dopslam_ros.cli.progress import with_progress
from dopslam_ros.lab.failure_injection.kinds import FAILURES
from dopslam_ros.system.stopping import Stop, until_stopped

if TYPE_CHECKING:
    from dopslam_ros.lab.failure_injection.trial import Trial

TEXT = "failure injection: a vehicle gets lost, and is it found again"
EXAMPLE = "dopslam inject --runs 200 --seed 12345 --json failures.json"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of the command."""
    add_scenario(parser, "paper")
    parser.add_argument(
        "--kinds", nargs="+", choices=list(FAILURES), default=list(FAILURES), help="default: all"
    )
    add_runs(parser, 200)
    add_json(parser)
    add_list(parser, "kinds of failures", FAILURES)


def run(options: Any) -> int:
    """Runs the trials, until Ctrl-C comes, and prints a table; raises ScenarioError."""
    import numpy as np

    from dopslam_ros.lab.failure_injection.summary import summarise_trials, trials_table
    from dopslam_ros.lab.failure_injection.trial import trial
    from dopslam_ros.simulation.scenario import load_scenario

    scenario = load_scenario(options.scenario)
    cases = list(itertools.product(options.kinds, range(options.runs)))
    trials: dict[str, list[Trial]] = {kind: [] for kind in options.kinds}
    with Stop(keep=True) as stop:
        for kind, number in until_stopped(with_progress(cases, len(cases), "inject")):
            rng = np.random.default_rng([options.seed, list(FAILURES).index(kind), number])
            trials[kind].append(trial(kind, scenario, rng))
        rows = {kind: summarise_trials(some) for kind, some in trials.items() if some}
    content = {"scenario": scenario.name, "seed": options.seed, "kinds": rows}
    write_json(options.json, {**content, "stopped": stop.asked})
    for line in trials_table(rows):
        print(line)
    return stop.code()
