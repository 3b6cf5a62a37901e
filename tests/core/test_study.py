"""Studies: the same numbers whoever computes them; who was given what, told right."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dopslam_ros.core.assignment import UNASSIGNED
from dopslam_ros.core.evaluation import StepRecord
from dopslam_ros.core.filter import Associations
from dopslam_ros.core.measurements import MeasurementSet
from dopslam_ros.core.model import with_doppler_std
from dopslam_ros.core.motion import Control
from dopslam_ros.core.scenario import Scenario, load_scenario
from dopslam_ros.core.simulator import CLUTTER, Snapshot
from dopslam_ros.core.study import (
    SourceTracker,
    bounds_parameters_for,
    filter_parameters_for,
    nominal_bounds,
    run_once,
    run_study,
)


@pytest.fixture(scope="module")
def short() -> Scenario:
    """The paper's scene, cut to a few steps."""
    scenario = load_scenario("paper")
    return replace(scenario, controls=scenario.controls[:6])


def numbers(records: list[StepRecord]) -> list[bytes]:
    return [
        np.array([*r.error, r.nees, r.gospa_va, r.gospa_sp, *r.bound, r.correct_weight]).tobytes()
        for r in records
    ]


def test_a_run_is_the_same_alone_and_among_others(short: Scenario) -> None:
    parameters = filter_parameters_for(short)
    alone = numbers(run_once(short, parameters, 9, 2))
    among = [numbers(run) for run in run_study(short, parameters, 3, 9, workers=1)]
    assert len(among) == 3 and len(alone) == 6
    assert among[2] == alone and among[0] != alone
    assert numbers(run_once(short, parameters, 10, 2)) != alone


def test_processes_do_not_change_the_numbers(short: Scenario) -> None:
    parameters = filter_parameters_for(short)
    here = [numbers(run) for run in run_study(short, parameters, 3, 9, workers=1)]
    there = [numbers(run) for run in run_study(short, parameters, 3, 9, workers=2)]
    assert here == there


def test_every_step_is_judged(short: Scenario) -> None:
    for record in run_once(short, filter_parameters_for(short), 9, 0):
        assert np.isfinite(record.error).all() and np.isfinite(record.bound).all()
        assert record.nees > 0.0 and record.seconds > 0.0
        assert 0.0 <= record.correct_weight <= 1.0 + 1e-12
        assert 0.0 <= record.gospa_va <= 60.0


def test_filter_and_bounds_take_the_models_of_the_scene() -> None:
    scenario = replace(
        with_doppler_std(load_scenario("paper"), 0.3),
        bs_position=(1.0, 2.0, 3.0),
        clutter_mean=4.0,
    )
    parameters = filter_parameters_for(scenario, coupling="marginal", gamma=4)
    assert parameters.bs_position == (1.0, 2.0, 3.0) and parameters.clutter_mean == 4.0
    assert parameters.measurement_noise_std[5] == 0.3
    assert (parameters.coupling, parameters.gamma) == ("marginal", 4)
    assert bounds_parameters_for(parameters).measurement_noise_std[5] == 0.3


def test_better_sensors_have_better_bounds() -> None:
    scenario = load_scenario("paper_bounds")
    good = replace(scenario, measurement_noise_std=(0.05, *[0.025] * 4, 0.05))
    fine, coarse = nominal_bounds(good), nominal_bounds(scenario)
    assert fine.peb < coarse.peb and fine.heb < coarse.heb and fine.ceb < coarse.ceb
    assert np.all(fine.leb < coarse.leb)


def snapshot(*sources: int) -> Snapshot:
    nothing = MeasurementSet(np.zeros((len(sources), 6)), np.zeros((len(sources), 6, 6)))
    return Snapshot(0, 0, Control(0.0, 0.0), np.zeros(4), nothing, np.array(sources))


def associations(rows: list[list[int]], weight: list[float], born: list[int]) -> Associations:
    return Associations(np.array(rows), np.array(weight), np.array(born))


def test_the_weight_of_the_correct_association() -> None:
    tracker = SourceTracker()
    none, new = np.zeros(0, dtype=np.int64), UNASSIGNED
    # BS, landmark 3 for the first time, clutter: right is the BS and twice new.
    first = associations([[0, new, new], [new, new, new]], [0.8, 0.2], [new, 7, 8])
    assert tracker.correct_weight(snapshot(0, 3, CLUTTER), first, none) == pytest.approx(0.8)
    # Landmark 3 is track 7 from now on; landmark 5 is new.
    known = np.array([7, 8])
    second = associations([[7, new], [8, new], [new, new], [7, 8]], [0.4, 0.3, 0.2, 0.1], [9, 10])
    assert tracker.correct_weight(snapshot(3, 5), second, known) == pytest.approx(0.4)
    # Track 10 is landmark 5, and a landmark keeps its first track as long as that lives.
    third = associations([[10, 7], [7, 10]], [0.9, 0.1], [new, new])
    assert tracker.correct_weight(snapshot(5, 3), third, np.array([7, 9, 10])) == pytest.approx(0.9)
    # Track 7 died: landmark 3 counts as new again.
    fourth = associations([[new], [9]], [0.7, 0.3], [11])
    assert tracker.correct_weight(snapshot(3), fourth, np.array([9, 10])) == pytest.approx(0.7)
    fifth = associations([[11], [new]], [0.6, 0.4], [new])
    assert tracker.correct_weight(snapshot(3), fifth, np.array([10, 11])) == pytest.approx(0.6)


def test_several_hypotheses_with_the_right_association_add_up() -> None:
    # The same association twice: split by the type of a landmark.
    twice = associations([[0], [0], [UNASSIGNED]], [0.5, 0.3, 0.2], [UNASSIGNED])
    weight = SourceTracker().correct_weight(snapshot(0), twice, np.zeros(0, dtype=np.int64))
    assert weight == pytest.approx(0.8)


def test_none_right_is_zero() -> None:
    wrong = associations([[UNASSIGNED]], [1.0], [4])
    weight = SourceTracker().correct_weight(snapshot(0), wrong, np.zeros(0, dtype=np.int64))
    assert weight == 0.0
