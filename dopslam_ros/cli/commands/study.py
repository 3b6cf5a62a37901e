"""``dopslam study``: filters beside each other, and their bound."""

from __future__ import annotations

import argparse
import sys
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dopslam_ros.cli.options import (
    add_json,
    add_list,
    add_runs,
    add_scenario,
    add_settings,
    positive_number,
    read_settings,
    whole_from_one,
    write_json,
)
from dopslam_ros.cli.progress import with_progress
from dopslam_ros.lab.study.names import FILTERS
from dopslam_ros.system.errors import UsageError

if TYPE_CHECKING:
    from dopslam_ros.lab.study.plan import Plan
    from dopslam_ros.lab.study.results import Collection
    from dopslam_ros.lab.study.run import Outcome

TEXT = "Monte Carlo: filters beside each other and their bound"
EXAMPLE = "dopslam study --filters joint marginal --doppler 0.1 none --out runs/study"

# Failures told one by one; the rest is in the folder.
MOST_TOLD = 5


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of the command."""
    add_scenario(parser, "paper")
    parser.add_argument(
        "--filters",
        nargs="+",
        default=["joint"],
        metavar="FILTER",
        help=f"{', '.join(FILTERS)}; also with settings of its own, as"
        " joint:gamma=20,prune_type=0.01 (default: joint); the others are compared with the first",
    )
    parser.add_argument(
        "--doppler",
        nargs="+",
        type=_doppler,
        metavar="M/S",
        help="standard deviations of the Doppler [m/s], none for without (default: the scene's)",
    )
    add_runs(parser, 100)
    parser.add_argument(
        "--out", type=Path, help="folder of the study; if it is there already, to go on with"
    )
    parser.add_argument("--workers", type=whole_from_one, help="processes (default: one a core)")
    parser.add_argument(
        "--scheduler", metavar="ADDRESS", help="compute on this Dask cluster: tcp://host:port"
    )
    add_settings(parser)
    add_json(parser)
    add_list(parser, "filters", FILTERS)


def run(options: Any) -> int:
    """Does a study as far as it is not done yet; returns 1 if a task failed.

    Raises:
        StudyError, ParameterError, UsageError, ScenarioError: it cannot be done as asked.
        KeyboardInterrupt: Ctrl-C; what is done is kept, and its summary printed.
    """
    from dopslam_ros.lab.study.folder import open_folder
    from dopslam_ros.lab.study.plan import StudyError
    from dopslam_ros.lab.study.results import Collection

    if options.scheduler is not None and options.workers is not None:
        raise UsageError("--workers are of this machine, --scheduler has its own: give one of them")
    plan = _plan(options)
    if options.out is not None:
        open_folder(options.out, plan)
    collection = Collection(plan, options.out)
    for text in collection.damaged:
        _say(f"{text}: computed anew")
    failed: list[Outcome] = []
    try:
        _compute(collection, options, failed)
    except (StudyError, KeyboardInterrupt):
        _finish(collection, options, failed)
        raise
    _finish(collection, options, failed)
    return 1 if failed else 0


def _plan(options: Any) -> Plan:
    from dopslam_ros.core.settings.layout import DOPPLER
    from dopslam_ros.lab.study.plan import Plan
    from dopslam_ros.simulation.scenario import load_scenario

    scenario = load_scenario(options.scenario)
    dopplers = options.doppler
    if dopplers is None:
        used = bool(scenario.used_components[DOPPLER])
        dopplers = [scenario.measurement_noise_std[DOPPLER] if used else None]
    return Plan(
        scenario=scenario,
        filters=tuple(options.filters),
        dopplers=tuple(dopplers),
        runs=options.runs,
        seed=options.seed,
        settings=read_settings(options),
    )


def _compute(collection: Collection, options: Any, failed: list[Outcome]) -> None:
    """Does what is missing; tasks that fail are added to ``failed``."""
    from dopslam_ros.lab.study.executors import outcomes_of

    tasks = collection.missing()
    total = sum(1 for _ in collection.plan.tasks())
    if not tasks:
        return
    if len(tasks) < total:
        _say(f"{total - len(tasks)} of {total} tasks are done already")
    found = outcomes_of(collection.plan, tasks, options.workers, options.scheduler, _say)
    with closing(found) as outcomes:
        for outcome in with_progress(outcomes, total, "study", total - len(tasks)):
            if outcome.part is not None:
                collection.add(outcome.task, outcome.part)
                continue
            failed.append(outcome)
            if len(failed) <= MOST_TOLD:
                _say(f"{outcome.task} failed: {outcome.error.strip().splitlines()[-1]}")


def _finish(collection: Collection, options: Any, failed: list[Outcome]) -> None:
    """Prints and writes what there is, and how to go on if it is not all."""
    from dopslam_ros.lab.study.outputs import FAILURES, write_failures

    missing = len(collection.missing())
    if options.out is not None:
        write_failures(options.out, failed)
    if collection.whole_runs():
        _report(collection, options)
    if failed:
        where = f": see {options.out / FAILURES}" if options.out else ", give --out to keep why"
        _say(f"{len(failed)} tasks failed{where}")
    if missing:
        kept = (
            f"the rest is kept in {options.out}, and the same command goes on from there"
            if options.out
            else "give --out to keep what is done"
        )
        _say(f"{missing} tasks are not done; {kept}")


def _report(collection: Collection, options: Any) -> None:
    """The table of the runs that are whole, and the files that were asked for."""
    from dopslam_ros.lab.study.outputs import timing, write_outputs
    from dopslam_ros.lab.study.summary import summarise_study
    from dopslam_ros.lab.study.table import study_table

    results, seconds = collection.results(), collection.seconds()
    summary = summarise_study(results)
    if options.out is not None:
        write_outputs(options.out, results, summary, seconds)
    write_json(options.json, summary)
    for line in study_table(summary, timing(seconds)):
        print(line)


def _say(text: str) -> None:
    print(f"dopslam: {text}", file=sys.stderr)


def _doppler(text: str) -> float | None:
    return None if text == "none" else positive_number(text)
