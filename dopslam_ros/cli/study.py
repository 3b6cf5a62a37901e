"""The command ``dopslam study``."""

from __future__ import annotations

import sys
from collections.abc import Generator, Sequence
from contextlib import closing
from typing import Any

from dopslam_ros.cli.options import read_settings, with_progress, write_json
from dopslam_ros.core.settings.layout import DOPPLER
from dopslam_ros.lab.study.executors import blas_is_limited, run_local, run_on_dask
from dopslam_ros.lab.study.folder import open_folder
from dopslam_ros.lab.study.outputs import FAILURES, timing, write_failures, write_outputs
from dopslam_ros.lab.study.plan import Plan, StudyError, Task
from dopslam_ros.lab.study.results import Collection
from dopslam_ros.lab.study.run import Outcome
from dopslam_ros.lab.study.summary import summarise_study
from dopslam_ros.lab.study.table import study_table
from dopslam_ros.simulation.scenario import load_scenario
from dopslam_ros.system.errors import UsageError

# Failures told one by one; the rest is in the folder.
MOST_TOLD = 5


def run(options: Any) -> int:
    """Does a study as far as it is not done yet; returns 1 if a task failed.

    Raises:
        StudyError, ParameterError, UsageError, ScenarioError: it cannot be done as asked.
        KeyboardInterrupt: Ctrl-C; what is done is kept, and its summary printed.
    """
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
    tasks = collection.missing()
    total = sum(1 for _ in collection.plan.tasks())
    if not tasks:
        return
    if len(tasks) < total:
        _say(f"{total - len(tasks)} of {total} tasks are done already")
    with closing(_outcomes(collection.plan, tasks, options)) as outcomes:
        for outcome in with_progress(outcomes, total, "study", total - len(tasks)):
            if outcome.part is not None:
                collection.add(outcome.task, outcome.part)
                continue
            failed.append(outcome)
            if len(failed) <= MOST_TOLD:
                _say(f"{outcome.task} failed: {outcome.error.strip().splitlines()[-1]}")


def _outcomes(plan: Plan, tasks: Sequence[Task], options: Any) -> Generator[Outcome, None, None]:
    if options.scheduler is not None:
        yield from run_on_dask(plan, tasks, options.scheduler, _say)
        return
    if not blas_is_limited():
        _say(
            "BLAS may use several threads, and the last digits depend on how many: install"
            " 'threadpoolctl', or set OMP_NUM_THREADS=1"
        )
    yield from run_local(plan, tasks, options.workers)


def _finish(collection: Collection, options: Any, failed: list[Outcome]) -> None:
    """Prints and writes what there is, and how to go on if it is not all."""
    missing = len(collection.missing())
    if options.out is not None:
        write_failures(options.out, failed)
    if collection.whole_runs():
        results, seconds = collection.results(), collection.seconds()
        summary = summarise_study(results)
        if options.out is not None:
            write_outputs(options.out, results, summary, seconds)
        write_json(options.json, summary)
        for line in study_table(summary, timing(seconds)):
            print(line)
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


def _say(text: str) -> None:
    print(f"dopslam: {text}", file=sys.stderr)
