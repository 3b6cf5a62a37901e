"""Judging runs: known errors give known summaries, and what is unknown is left out."""

from __future__ import annotations

import math

import numpy as np
import pytest

from dopslam_ros.core.pcrb.bounds import Bounds
from dopslam_ros.core.pmb import LandmarkEstimates
from dopslam_ros.offline.evaluation import NOT_JUDGED, StepRecord, judge_step, summarise

TRUTH = np.array([1.0, 2.0, 3.1, 4.0])
COVARIANCE = np.diag([4.0, 1.0, 0.01, 9.0])
BOUND = Bounds(0.1, 0.01, 0.2, np.array([1.0]))


def reported(types: list[int], positions: list[list[float]]) -> LandmarkEstimates:
    count = len(types)
    return LandmarkEstimates(
        np.arange(1, count + 1),
        np.array(types, dtype=np.int64),
        np.zeros((count, 3)),
        np.ones(count),
        np.reshape(np.array(positions, dtype=float), (-1, 3)),
        np.tile(np.eye(3), (count, 1, 1)),
    )


def test_a_step_is_judged_against_what_is_known() -> None:
    landmarks = reported([1, 2, 1], [[3.0, 0.0, 0.0], [0.0, 1.0, 0.0], [90.0, 0.0, 0.0]])
    record = judge_step(
        TRUTH + np.array([2.0, -1.0, 0.1, 3.0]),
        COVARIANCE,
        landmarks,
        TRUTH,
        np.zeros((1, 3)),
        np.zeros((2, 3)),
        BOUND,
        0.004,
    )
    np.testing.assert_allclose(record.error, [2.0, -1.0, 0.1, 3.0])
    assert record.nees == pytest.approx(1.0 + 1.0 + 1.0 + 1.0)
    assert record.gospa_va == pytest.approx(math.sqrt(9.0 + 200.0))  # one near, one false
    assert record.gospa_sp == pytest.approx(math.sqrt(1.0 + 200.0))  # one near, one missed
    assert record.va == pytest.approx((math.sqrt(209.0), 9.0, 0.0, 200.0))
    assert record.sp == pytest.approx((math.sqrt(201.0), 1.0, 200.0, 0.0))
    assert record.bound.tolist() == [0.1, 0.01, 0.2]
    assert record.seconds == 0.004


def test_headings_wrap() -> None:
    estimate = TRUTH + np.array([0.0, 0.0, 0.1 - 2 * math.pi, 0.0])
    record = judge_step(estimate, COVARIANCE, reported([], []), TRUTH, None, None, None)
    np.testing.assert_allclose(record.error, [0.0, 0.0, 0.1, 0.0], atol=1e-12)


def test_without_truth_nothing_is_judged_and_nothing_summarised() -> None:
    record = judge_step(TRUTH, COVARIANCE, reported([], []), None, None, None, None)
    assert np.isnan(record.error).all() and math.isnan(record.nees)
    assert math.isnan(record.gospa_va) and math.isnan(record.gospa_sp)
    assert summarise([record, record]) == {"steps": 2}
    assert summarise([]) == {"steps": 0}


def record(error: list[float], **known: float) -> StepRecord:
    values = {"nees": 4.0, "seconds": math.nan, **known}
    bound = values.pop("peb", math.nan)
    va, sp = (
        NOT_JUDGED._replace(distance=values.pop(name, math.nan))
        for name in ("gospa_va", "gospa_sp")
    )
    return StepRecord(error=np.array(error), va=va, sp=sp, bound=np.full(3, bound), **values)


def test_the_summary_averages_over_steps() -> None:
    run = [
        record([3.0, 4.0, 0.0, 1.0], nees=2.0, gospa_va=10.0, gospa_sp=1.0, seconds=0.001),
        record([0.0] * 4, nees=4.0, gospa_va=4.0, gospa_sp=1.0, seconds=0.003),
        record([0.0, 0.0, 0.02, -1.0], nees=6.0, gospa_va=20.0, gospa_sp=1.0, seconds=0.002),
        record([0.0] * 4, nees=8.0, gospa_va=6.0, gospa_sp=2.0, seconds=0.002),
    ]
    summary = summarise(run)
    assert summary["steps"] == 4
    assert summary["position_rmse"] == pytest.approx(2.5)
    assert summary["heading_rmse_deg"] == pytest.approx(math.degrees(0.01))
    assert summary["clock_bias_rmse"] == pytest.approx(math.sqrt(0.5))
    assert summary["nees_mean"] == pytest.approx(5.0)
    assert summary["gospa_va"] == [10.0, 4.0, 20.0, 6.0]
    assert summary["gospa_sp"] == [1.0, 1.0, 1.0, 2.0]
    assert summary["step_ms_p50"] == pytest.approx(2.0)
    assert 2.9 < summary["step_ms_p99"] <= 3.0
    assert "bound_position_rms" not in summary


def test_bounds_are_averaged_as_squares_where_they_are_known() -> None:
    unknown = record([math.nan] * 4, peb=math.inf)
    summary = summarise([record([0.0] * 4, peb=3.0), record([0.0] * 4, peb=4.0), unknown])
    assert summary["bound_position_rms"] == pytest.approx(math.sqrt(12.5))
    assert summary["bound_heading_rms_deg"] == pytest.approx(math.degrees(math.sqrt(12.5)))
    assert summary["bound_clock_rms"] == pytest.approx(math.sqrt(12.5))
    assert summary["position_rmse"] == 0.0
