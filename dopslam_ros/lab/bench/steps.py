"""The filter's step on the paper's scene, beside the step as a textbook has it."""

from __future__ import annotations

import importlib.util
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import dopslam_ros
from dopslam_ros.core.models.measurements import MeasurementSet
from dopslam_ros.core.models.motion import ControlSpan
from dopslam_ros.core.pmb import FilterParameters, Posterior, initial_posterior, prepare, step
from dopslam_ros.lab.bench.records import Measured, NotMeasured, milliseconds, times_as_long
from dopslam_ros.simulation.matched import filter_parameters_for
from dopslam_ros.simulation.scenario import Scenario, load_scenario
from dopslam_ros.simulation.simulator import simulate
from dopslam_ros.system.stopping import until_stopped


class Inputs(NamedTuple):
    """What a step gets."""

    measurements: MeasurementSet
    spans: tuple[ControlSpan, ...]
    speed: float


def inputs_of(scenario: Scenario, seed: int) -> list[Inputs]:
    """Those of all steps of a simulated run."""
    inputs: list[Inputs] = []
    spans: tuple[ControlSpan, ...] = ()
    for snapshot in simulate(scenario, np.random.default_rng(seed)):
        inputs.append(Inputs(snapshot.measurements, spans, snapshot.control.speed))
        spans = (ControlSpan(snapshot.control, scenario.period),)
    return inputs


class Task(NamedTuple):
    """Steps to be done.

    Attributes:
        advance: a step.
        start: the density before.
        run: inputs of the steps.
    """

    advance: Callable[[Any, Inputs], Any]
    start: Any
    run: Sequence[Inputs]


def step_seconds(*tasks: Task) -> list[list[float]]:
    """How long each step of each task takes [s].

    The tasks take turns, a step each, so that what else the machine does falls on all alike.
    """
    densities: list[Any] = [task.start for task in tasks]
    seconds: list[list[float]] = [[] for _ in tasks]
    for turn in until_stopped(zip(*(task.run for task in tasks), strict=True)):
        for number, inputs in enumerate(turn):
            started = time.perf_counter()
            densities[number] = tasks[number].advance(densities[number], inputs)
            seconds[number].append(time.perf_counter() - started)
    return seconds


def filter_step(parameters: FilterParameters) -> Callable[[Posterior, Inputs], Posterior]:
    """The filter's step as a task needs it."""

    def advance(state: Posterior, inputs: Inputs) -> Posterior:
        observed = prepare(inputs.measurements, parameters)
        return step(state, observed, inputs.spans, inputs.speed, parameters)[0]

    return advance


def joint(quick: bool) -> Measured:
    """The form that keeps the correlation of vehicle and map."""
    return _step_of_the_paper("joint", quick)


def marginal(quick: bool) -> Measured:
    """The paper's form."""
    return _step_of_the_paper("marginal", quick)


def _step_of_the_paper(coupling: str, quick: bool) -> Measured:
    """All steps of several runs, warm; the textbook on the same runs, a run each in turns."""
    scenario = load_scenario("paper")
    parameters = filter_parameters_for(scenario, coupling=coupling)
    runs = [inputs_of(scenario, seed) for seed in range(1 if quick else 10)]
    ours = [Task(filter_step(parameters), initial_posterior(parameters), run) for run in runs]
    step_seconds(ours[0])  # everything compiled, loaded and cached
    try:
        textbook = load_textbook()
    except NotMeasured as reason:
        seconds = [one for task in ours for one in step_seconds(task)[0]]
        return Measured((milliseconds("step", seconds),), notes=(str(reason),))

    def by_the_book(density: Any, inputs: Inputs) -> Any:
        return textbook.textbook_step(density, *inputs, parameters)[0]

    theirs = [Task(by_the_book, textbook.start(parameters), run) for run in runs]
    # Not a step each: in the caches that the other leaves behind it would not be warm.
    pairs = [
        (step_seconds(one)[0], step_seconds(other)[0])
        for one, other in zip(ours, theirs, strict=True)
    ]
    mine = milliseconds("step", [one for run, _ in pairs for one in run])
    book = milliseconds("textbook step", [one for _, run in pairs for one in run])
    return Measured((mine, book), (times_as_long(book, mine),))


def load_textbook() -> Any:
    """The module ``tests/textbook.py`` of the source checkout that this package is in.

    Raises:
        NotMeasured: the package is installed without its tests.
    """
    name, path = "dopslam_textbook", Path(dopslam_ros.__file__).parents[1] / "tests" / "textbook.py"
    if name in sys.modules:
        return sys.modules[name]
    spec = importlib.util.spec_from_file_location(name, path)
    if not path.is_file() or spec is None or spec.loader is None:
        raise NotMeasured("tests/textbook.py is not beside this package: run from a checkout")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # its dataclasses look for it there
    spec.loader.exec_module(module)
    return module
