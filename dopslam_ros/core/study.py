"""Monte Carlo: many runs of a scenario through filter and bounds, and what comes out on average."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import partial

import numpy as np

from dopslam_ros.core.arrays import IntArray
from dopslam_ros.core.assignment import UNASSIGNED
from dopslam_ros.core.bounds import Bounds
from dopslam_ros.core.channel import LandmarkType
from dopslam_ros.core.evaluation import StepRecord, judge_step
from dopslam_ros.core.filter import Associations, FilterParameters
from dopslam_ros.core.filter.step import BS_ID
from dopslam_ros.core.parameters import shared_values
from dopslam_ros.core.scenario import Scenario
from dopslam_ros.core.session import (
    BoundsOutput,
    BoundsParameters,
    BoundsSession,
    FilterSession,
    WorldState,
)
from dopslam_ros.core.simulator import (
    CLUTTER,
    Snapshot,
    all_landmarks,
    nominal_trajectory,
    simulate,
)


def filter_parameters_for(scenario: Scenario, **settings: object) -> FilterParameters:
    """The filter that knows the scenario's models, with settings of its own."""
    return FilterParameters(**{**shared_values(scenario, FilterParameters), **settings})


def bounds_parameters_for(model: object) -> BoundsParameters:
    """Bounds with the models of a scenario or of a filter."""
    return BoundsParameters(**shared_values(model, BoundsParameters))


def run_generator(seed: int, run: int) -> np.random.Generator:
    """The generator of one run of a study: the same whoever computes it, and in whatever order."""
    return np.random.default_rng([seed, run])


def run_once(
    scenario: Scenario, parameters: FilterParameters, seed: int, run: int
) -> list[StepRecord]:
    """One simulated run through the filter and, with the detections drawn, the bounds."""
    filtering = FilterSession(parameters)
    bounding = BoundsSession(bounds_parameters_for(scenario))
    positions, types = all_landmarks(scenario)
    vas, sps = (positions[types == kind] for kind in (LandmarkType.VA, LandmarkType.SP))
    tracker = SourceTracker()
    records = []
    for snapshot in simulate(scenario, run_generator(seed, run)):
        stamp, control = snapshot.stamp_ns, snapshot.control
        known = filtering.state.track_ids
        detected = np.isin(np.arange(len(types)), snapshot.sources)
        world = WorldState(snapshot.state, np.arange(len(types)), types, positions, detected)
        list(bounding.add_control(stamp, control.speed, control.turn_rate))
        (bound,) = bounding.add_world(stamp, world)
        list(filtering.add_control(stamp, control.speed, control.turn_rate))
        for output in filtering.add_measurements(stamp, snapshot.measurements):
            records.append(
                judge_step(
                    output.state.ue_mean,
                    output.state.ue_covariance,
                    output.landmarks,
                    snapshot.state,
                    vas,
                    sps,
                    bound.with_doppler,
                    tracker.correct_weight(snapshot, output.associations, known),
                    output.step_seconds,
                )
            )
    return records


def run_study(
    scenario: Scenario,
    parameters: FilterParameters,
    runs: int,
    seed: int,
    workers: int | None = None,
) -> Iterator[list[StepRecord]]:
    """Runs 0 ... runs - 1 in order, computed on all cores (or as many as ``workers``)."""
    one = partial(run_once, scenario, parameters, seed)
    if workers == 1:
        yield from map(one, range(runs))
        return
    # Ctrl-C is for this process alone, which then gives up what has not begun.
    ignore = (signal.SIGINT, signal.SIG_IGN)
    pool = ProcessPoolExecutor(workers, initializer=signal.signal, initargs=ignore)
    try:
        yield from pool.map(one, range(runs))
    finally:
        pool.shutdown(cancel_futures=True)


class SourceTracker:
    """Remembers which track stands for which true landmark: the one born from its path."""

    def __init__(self) -> None:
        self._owner: dict[int, int] = {}

    def correct_weight(
        self, snapshot: Snapshot, associations: Associations, known: IntArray
    ) -> float:
        """Weight, among the hypotheses kept, of the association that is true.

        Args:
            snapshot: with the true sources.
            associations: of the filter at this snapshot.
            known: ids of the tracks before the snapshot.
        """
        alive = set(known.tolist())
        self._owner = {source: track for source, track in self._owner.items() if track in alive}
        true = np.array([self._true_id(source) for source in snapshot.sources.tolist()])
        right = (associations.ids == true).all(axis=1)
        for source, born in zip(snapshot.sources.tolist(), associations.born.tolist(), strict=True):
            if source > 0 and born != UNASSIGNED:
                self._owner.setdefault(source, born)
        return float(associations.weight[right].sum())

    def _true_id(self, source: int) -> int:
        if source == CLUTTER:
            return UNASSIGNED
        return BS_ID if source == 0 else self._owner.get(source, UNASSIGNED)


def nominal_bounds(scenario: Scenario) -> Bounds:
    """Bounds at the last step along the path without process noise, detections in expectation."""
    bounding = BoundsSession(bounds_parameters_for(scenario))
    positions, types = all_landmarks(scenario)
    outputs: list[BoundsOutput] = []
    for step, state in enumerate(nominal_trajectory(scenario)):
        stamp, control = scenario.stamp_ns(step), scenario.controls[step]
        world = WorldState(state, np.arange(len(types)), types, positions)
        outputs += bounding.add_control(stamp, control.speed, control.turn_rate)
        outputs += bounding.add_world(stamp, world)
    return outputs[-1].with_doppler
