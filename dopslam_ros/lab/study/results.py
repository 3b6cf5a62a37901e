"""What a study has found, for every filter, Doppler noise, run and step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dopslam_ros.core.linalg.arrays import FloatArray
from dopslam_ros.lab.study.folder import DamagedPart, read_part, read_plan, write_part
from dopslam_ros.lab.study.plan import Plan, StudyError, Task
from dopslam_ros.lab.study.run import FIELDS, Part

Case = tuple[str, float | None]


@dataclass(frozen=True, eq=False)
class Results:
    """The runs that every filter has done with every Doppler noise: the same for all of them.

    Attributes:
        plan: the study.
        tables: (runs, steps, FIELDS) by filter and Doppler noise.
        numbers: of the runs, when it is not all of the plan.
    """

    plan: Plan
    tables: Mapping[Case, FloatArray]
    numbers: Sequence[int] | None = None

    @property
    def run_numbers(self) -> Sequence[int]:
        """(runs,) which runs of the plan the tables hold."""
        return range(self.plan.runs) if self.numbers is None else self.numbers

    def field(self, filter: str, doppler: float | None, name: str) -> FloatArray:
        """(runs, steps) one of FIELDS."""
        return self.tables[filter, doppler][:, :, FIELDS.index(name)]


class Collection:
    """The parts of a study as they come in.

    Attributes:
        plan: the study.
        damaged: what was wrong with files of the folder; their tasks count as not done.
    """

    def __init__(self, plan: Plan, folder: Path | None) -> None:
        """Begins with what the folder of the study has, if there is one; it is kept there."""
        self.plan = plan
        self.damaged: list[str] = []
        self._folder = folder
        self._parts: dict[Task, Part] = {}
        if folder is not None:
            self._read(folder)

    def _read(self, folder: Path) -> None:
        for task in self.plan.tasks():
            try:
                part = read_part(folder, task, self.plan.scenario.steps)
            except DamagedPart as damage:
                self.damaged.append(str(damage))
            else:
                if part is not None:
                    self._parts[task] = part

    def missing(self) -> list[Task]:
        """What is still to be done."""
        return [task for task in self.plan.tasks() if task not in self._parts]

    def add(self, task: Task, part: Part) -> None:
        """Takes in what a task gave. Raises OSError if it cannot be kept."""
        if self._folder is not None:
            write_part(self._folder, task, part)
        self._parts[task] = part

    def whole_runs(self) -> list[int]:
        """The runs that every filter has done with every Doppler noise."""
        lacking = {task.run for task in self.missing()}
        return [run for run in range(self.plan.runs) if run not in lacking]

    def results(self) -> Results:
        """The runs that are whole.

        Raises:
            StudyError: there is none.
        """
        cases = [(label, doppler) for doppler in self.plan.dopplers for label in self.plan.filters]
        whole = self.whole_runs()
        if not whole:
            raise StudyError("no run of the study is done by every filter yet")
        tables = {
            case: np.array([self._parts[Task(*case, run)].table for run in whole]) for case in cases
        }
        return Results(self.plan, tables, whole)

    def seconds(self) -> dict[Case, FloatArray]:
        """Times of all steps done, by filter and Doppler noise."""
        times: dict[Case, list[FloatArray]] = {}
        for task, part in self._parts.items():
            times.setdefault((task.filter, task.doppler), []).append(part.seconds)
        return {case: np.concatenate(parts) for case, parts in times.items()}


def load_results(folder: str | Path) -> Results:
    """The results of a study in its folder; of one that was stopped, the runs that are whole.

    Raises:
        StudyError: no study, no run that is whole, or a damaged file; the message says what to do.
    """
    folder = Path(folder)
    collection = Collection(read_plan(folder), folder)
    if collection.damaged:
        raise StudyError(f"{collection.damaged[0]}: do the study again, which computes it anew")
    return collection.results()
