"""What a study says in a few numbers, with the interval that chance leaves for each of them.

Runs are independent, steps of a run are not: everything is averaged over the steps of a run first,
and the bootstrap draws runs. All filters and Doppler noises have the same runs, and the bootstrap
draws the same ones for all of them, so that differences are those of pairs.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from dopslam_ros.core.linalg.arrays import FloatArray, IntArray
from dopslam_ros.core.linalg.quantiles import chi_square
from dopslam_ros.core.settings.layout import VEHICLE
from dopslam_ros.lab.study.results import Case, Results
from dopslam_ros.lab.study.run import FIELDS

CONFIDENCE = 0.95
# At the end of a run the map should be there; the distances at its beginning say little.
LAST_STEPS = 10
RESAMPLES = 2000
# Resamples drawn at once: bounds the memory.
CHUNK = 100
SEED = 20_220_601
UE_DIMENSION = len(VEHICLE)
# What is compared with the first filter, as a ratio.
COMPARED = ("position_rmse", "heading_rmse_deg", "clock_bias_rmse", "gospa_va", "gospa_sp")


class Interval(NamedTuple):
    """A number found, and where it may lie with other runs.

    Attributes:
        value: of all runs.
        low: end of the interval that holds it with CONFIDENCE; NaN from a single run.
        high: its other end.
    """

    value: float
    low: float
    high: float


class Averages(NamedTuple):
    """Means over steps, one for each run or resample.

    Attributes:
        squares: (..., 6) squared errors of position [m^2] (both axes together), heading [rad^2],
            clock bias [m^2], and squared bounds of the same.
        plain: (..., 4) NEES, GOSPA of VAs and SPs at the last steps [m], weight of the correct
            association.
    """

    squares: FloatArray
    plain: FloatArray


def summarise_study(results: Results) -> dict[str, Any]:
    """The summary of a study as it goes into JSON; the same bits for the same results.

    RMSE is over all steps and runs, GOSPA the mean over the last LAST_STEPS steps. ``nees_band``
    holds the mean NEES at a step with CONFIDENCE if the covariance is honest. ``to_first`` are
    ratios to the first filter, of the same runs. Numbers that do not exist are NaN.
    """
    plan = results.plan
    runs = len(results.run_numbers)
    cases = [(label, doppler) for doppler in plan.dopplers for label in plan.filters]
    averages = {case: averages_of(results.tables[case]) for case in cases}
    return {
        "scenario": plan.scenario.name,
        "seed": plan.seed,
        "runs": runs,
        "runs_planned": plan.runs,
        "steps": plan.scenario.steps,
        "settings": dict(plan.settings),
        "confidence": CONFIDENCE,
        "nees_band": nees_band(runs),
        "rows": summary_rows(averages, plan.filters[0]),
    }


def summary_rows(averages: Mapping[Case, Averages], first: str) -> list[dict[str, Any]]:
    """The numbers of each case with their intervals, and over those of the first filter.

    Args:
        averages: of the same runs in every case.
        first: the filter that the others are compared with.
    """
    draws = resamples(len(next(iter(averages.values())).plain))
    drawn = {case: _resampled(of_run, draws) for case, of_run in averages.items()}
    return [_row(case, first, averages, drawn) for case in averages]


def averages_of(table: FloatArray) -> Averages:
    """Means over the steps of each run.

    Args:
        table: (runs, steps, FIELDS).
    """
    column = {name: table[:, :, number] for number, name in enumerate(FIELDS)}
    square = {name: np.square(values) for name, values in column.items()}
    squares = [
        square["error_x"] + square["error_y"],
        *(square[name] for name in ("error_heading", "error_clock", "peb", "heb", "ceb")),
    ]
    plain = [
        column["nees"],
        column["gospa_va"][:, -LAST_STEPS:],
        column["gospa_sp"][:, -LAST_STEPS:],
        column["correct_weight"],
    ]
    return Averages(
        np.stack([values.mean(axis=1) for values in squares], axis=-1),
        np.stack([values.mean(axis=1) for values in plain], axis=-1),
    )


def statistics(averages: Averages) -> dict[str, FloatArray]:
    """The numbers of a row, (...) each, from means over steps and runs (..., 6) and (..., 4)."""
    roots = np.sqrt(averages.squares)
    position, heading, clock, peb, heb, ceb = np.moveaxis(roots, -1, 0)
    nees, gospa_va, gospa_sp, weight = np.moveaxis(averages.plain, -1, 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = position / peb, heading / heb, clock / ceb
    return {
        "position_rmse": position,
        "heading_rmse_deg": np.degrees(heading),
        "clock_bias_rmse": clock,
        "bound_position_rms": peb,
        "bound_heading_rms_deg": np.degrees(heb),
        "bound_clock_rms": ceb,
        "position_to_bound": ratios[0],
        "heading_to_bound": ratios[1],
        "clock_to_bound": ratios[2],
        "nees_mean": nees,
        "gospa_va": gospa_va,
        "gospa_sp": gospa_sp,
        "correct_association_weight": weight,
    }


def nees_band(runs: int) -> list[float]:
    """Where the mean NEES of so many runs at a step lies with CONFIDENCE, from chi2."""
    tail = (1.0 - CONFIDENCE) / 2.0
    ends = chi_square([tail, 1.0 - tail], UE_DIMENSION * runs) / runs
    return [float(end) for end in ends]


def resamples(runs: int) -> IntArray:
    """(RESAMPLES, runs) the runs that each resample of the bootstrap draws; always the same."""
    return np.random.default_rng(SEED).integers(runs, size=(RESAMPLES, runs))


def _row(
    case: Case, first: str, averages: Mapping[Case, Averages], drawn: Mapping[Case, Averages]
) -> dict[str, Any]:
    label, doppler = case
    values, resampled = _found(averages[case]), statistics(drawn[case])
    row: dict[str, Any] = {"filter": label, "doppler": doppler}
    row |= {name: _interval(values[name], resampled[name])._asdict() for name in values}
    if label != first:
        ours, theirs = values, _found(averages[first, doppler])
        their_resampled = statistics(drawn[first, doppler])
        with np.errstate(divide="ignore", invalid="ignore"):
            row["to_first"] = {
                name: _interval(
                    ours[name] / theirs[name], resampled[name] / their_resampled[name]
                )._asdict()
                for name in COMPARED
            }
    return row


def _found(averages: Averages) -> dict[str, FloatArray]:
    """The statistics of all runs."""
    return statistics(Averages(averages.squares.mean(axis=0), averages.plain.mean(axis=0)))


def _resampled(averages: Averages, draws: IntArray) -> Averages:
    """The means over the runs of each resample; a single run says nothing about others: NaN."""
    if draws.shape[1] < 2:
        return Averages(*(np.full((1, values.shape[1]), np.nan) for values in averages))
    chunks = [draws[start : start + CHUNK] for start in range(0, len(draws), CHUNK)]
    means = [
        np.concatenate([values[chunk].mean(axis=1) for chunk in chunks]) for values in averages
    ]
    return Averages(*means)


def _interval(value: FloatArray, resampled: FloatArray) -> Interval:
    """The percentile interval of the bootstrap."""
    tail = (1.0 - CONFIDENCE) / 2.0
    with np.errstate(invalid="ignore"):
        low, high = np.quantile(resampled, [tail, 1.0 - tail])
    return Interval(float(value), float(low), float(high))
