"""One task of a study: a run through a filter and, with the detections drawn, the bounds."""

from __future__ import annotations

import traceback
from typing import NamedTuple

import numpy as np

from dopslam_ros.core.linalg.arrays import FloatArray
from dopslam_ros.core.session.bounding import BoundsSession, WorldState
from dopslam_ros.core.settings.layout import LandmarkType
from dopslam_ros.core.settings.model import with_doppler_std
from dopslam_ros.lab.study.labels import make_estimator
from dopslam_ros.lab.study.plan import Plan, StudyError, Task, run_generator, software
from dopslam_ros.offline.evaluation import StepRecord, judge_step
from dopslam_ros.simulation.matched import bounds_parameters_for
from dopslam_ros.simulation.simulator import all_landmarks, simulate
from dopslam_ros.system.stopping import Stop, until_stopped

# Errors in x, y [m], heading [rad], clock bias [m]; GOSPA [m]; bounds [m], [rad], [m].
FIELDS = (
    "error_x",
    "error_y",
    "error_heading",
    "error_clock",
    "nees",
    "gospa_va",
    "gospa_sp",
    "peb",
    "heb",
    "ceb",
    "correct_weight",
)


class Part(NamedTuple):
    """What a task gave.

    Attributes:
        table: (steps, FIELDS), the same whoever computes it.
        seconds: (steps,) time that the filter took.
    """

    table: FloatArray
    seconds: FloatArray


class Outcome(NamedTuple):
    """How a task ended: with a part, or with an error.

    Attributes:
        task: which.
        part: its result, or None.
        error: the trace of the error, or "".
    """

    task: Task
    part: Part | None
    error: str


def run_task(plan: Plan, task: Task) -> Part:
    """One run of the scene through one filter, judged at every step.

    Raises:
        EstimatorError: the filter had no estimate at a step.
        KeyboardInterrupt: Ctrl-C, within a Stop between two steps.
    """
    scenario = with_doppler_std(plan.scenario, task.doppler)
    estimator = make_estimator(task.filter, scenario, plan.settings)
    bounding = BoundsSession(bounds_parameters_for(scenario))
    positions, types = all_landmarks(scenario)
    vas, sps = (positions[types == kind] for kind in (LandmarkType.VA, LandmarkType.SP))
    rows, seconds = [], []
    for snapshot in until_stopped(simulate(scenario, run_generator(plan.seed, task.run))):
        control = snapshot.control
        detected = np.isin(np.arange(len(types)), snapshot.sources)
        world = WorldState(snapshot.state, np.arange(len(types)), types, positions, detected)
        list(bounding.add_control(snapshot.stamp_ns, control.speed, control.turn_rate))
        (bound,) = bounding.add_world(snapshot.stamp_ns, world)
        estimate = estimator.step(snapshot)
        judged = judge_step(
            estimate.mean,
            estimate.covariance,
            estimate.landmarks,
            snapshot.state,
            vas,
            sps,
            bound.with_doppler,
        )
        rows.append(table_row(judged, estimate.correct_weight))
        seconds.append(estimate.seconds)
    return Part(np.array(rows), np.array(seconds))


def table_row(judged: StepRecord, correct_weight: float) -> list[float]:
    """A step as FIELDS."""
    gospas = (judged.gospa_va, judged.gospa_sp)
    return [*judged.error, judged.nees, *gospas, *judged.bound, correct_weight]


def execute(plan: Plan, versions: dict[str, str], task: Task) -> Outcome:
    """``run_task`` wherever it is sent; what goes wrong is told, not raised.

    Args:
        plan: the study.
        versions: of the software there; another one here would give other numbers.
        task: which task.

    Raises:
        KeyboardInterrupt: Ctrl-C, between two steps.
    """
    try:
        check_software(versions)
        with Stop():
            return Outcome(task, run_task(plan, task), "")
    except Exception:
        return Outcome(task, None, traceback.format_exc())


def check_software(versions: dict[str, str]) -> None:
    """Raises StudyError if this process has other versions than the one that leads the study."""
    for name, version in software().items():
        if version != versions[name]:
            raise StudyError(
                f"a worker has {name} {version}, the study {versions[name]}: install the same"
            )
