"""What a study computes: filters x Doppler noises x runs of one scene."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numba
import numpy as np
import scipy

from dopslam_ros import __version__
from dopslam_ros.core.pmb import FilterParameters
from dopslam_ros.core.settings.parameters import ParameterError, checked_values
from dopslam_ros.lab.study.labels import check_label
from dopslam_ros.simulation.scenario import Scenario, parse_scenario, scenario_content


class StudyError(ValueError):
    """A study that cannot be done as asked; the message says why and what to do."""


class Task(NamedTuple):
    """One run of one filter.

    Attributes:
        filter: its label.
        doppler: noise of the Doppler [m/s], None for without Doppler.
        run: number of the run, 0, 1, ...
    """

    filter: str
    doppler: float | None
    run: int

    def __str__(self) -> str:
        return f"filter {self.filter}, Doppler {doppler_name(self.doppler)}, run {self.run}"


@dataclass(frozen=True, eq=False)
class Plan:
    """A study.

    Attributes:
        scenario: the scene; its own Doppler noise counts for nothing, that of ``dopplers`` does.
        filters: labels as ``labels.make_estimator`` takes them; the others are compared with
            the first.
        dopplers: noises of the Doppler [m/s], None for without Doppler.
        runs: how many.
        seed: of the runs.
        settings: of all filters, beside what the scene says.

    Raises:
        StudyError, ParameterError: it cannot be done.
    """

    scenario: Scenario
    filters: tuple[str, ...]
    dopplers: tuple[float | None, ...]
    runs: int
    seed: int
    settings: Mapping[str, object] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name, items in (("filter", self.filters), ("Doppler noise", self.dopplers)):
            if not items:
                raise StudyError(f"a study needs at least one {name}")
            twice = [item for item in items if items.count(item) > 1]
            if twice:
                raise StudyError(f"{name} {twice[0]} is given twice: name each once")
        for doppler in self.dopplers:
            if doppler is not None and not 0.0 < doppler < math.inf:
                raise StudyError(f"Doppler noise {doppler} m/s: give a number above 0, or none")
        if self.runs < 1 or self.seed < 0:
            raise StudyError(f"runs {self.runs}, seed {self.seed}: from 1 and from 0 on")
        for label in self.filters:
            check_label(label, self.settings)

    def tasks(self) -> Iterator[Task]:
        """All tasks, run by run: a study that is stopped has whole runs to compare."""
        for run in range(self.runs):
            for doppler in self.dopplers:
                for label in self.filters:
                    yield Task(label, doppler, run)


def run_generator(seed: int, run: int) -> np.random.Generator:
    """The generator of one run: common random numbers for all filters and Doppler noises.

    The simulator draws the same numbers whatever is measured, so that two tasks of the same run
    differ in the filter or the noise of the Doppler, and in nothing else.
    """
    return np.random.default_rng([seed, run])


def doppler_name(doppler: float | None) -> str:
    """A Doppler noise as the command line and files have it, every digit of it."""
    return "none" if doppler is None else repr(float(doppler))


def software() -> dict[str, str]:
    """The versions that numbers depend on."""
    return {
        "dopslam_ros": __version__,
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        "numba": numba.__version__,
    }


def plan_content(plan: Plan) -> dict[str, Any]:
    """A plan with everything that its results depend on, as JSON takes it."""
    return {
        "software": software(),
        "seed": plan.seed,
        "runs": plan.runs,
        "filters": list(plan.filters),
        "dopplers": list(plan.dopplers),
        "settings": dict(plan.settings),
        "scenario": scenario_content(plan.scenario),
    }


def parse_plan(content: Any) -> Plan:
    """The plan of what ``plan_content`` gave, after JSON.

    Raises:
        StudyError: it is no plan.
    """
    try:
        return Plan(
            scenario=parse_scenario(_with_nan(content["scenario"])),
            filters=tuple(content["filters"]),
            dopplers=tuple(content["dopplers"]),
            runs=content["runs"],
            seed=content["seed"],
            settings=checked_values(FilterParameters, _with_nan(content["settings"])),
        )
    except (KeyError, TypeError, AttributeError) as error:
        raise StudyError(f"not the plan of a study: {error!r}") from error
    except ParameterError as error:
        raise StudyError(f"not a plan that this version can use: {error}") from error


def _with_nan(value: Any) -> Any:
    """JSON has null where a parameter is NaN."""
    if isinstance(value, dict):
        return {key: _with_nan(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_with_nan(item) for item in value]
    return math.nan if value is None else value


def differences(ours: Any, theirs: Any, name: str = "") -> list[str]:
    """Where two contents differ, in words: what it is, here and there."""
    if isinstance(ours, dict) and isinstance(theirs, dict):
        keys = {**ours, **theirs}
        parts = [
            differences(ours.get(key), theirs.get(key), f"{name}.{key}" if name else key)
            for key in keys
        ]
        return [text for part in parts for text in part]
    return [] if ours == theirs else [f"{name} is {_short(ours)}, there {_short(theirs)}"]


def _short(value: Any) -> str:
    text = str(value)
    return text if len(text) <= 60 else text[:57] + "..."
