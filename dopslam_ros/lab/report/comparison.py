"""Cases beside each other in numbers: those of the table, and those of the curves."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import reduce
from typing import Any, NamedTuple

import numpy as np

from dopslam_ros.core.linalg.arrays import FloatArray, IntArray
from dopslam_ros.core.linalg.quantiles import student_t
from dopslam_ros.core.settings.layout import VEHICLE, X, Y
from dopslam_ros.lab.report.cases import Case
from dopslam_ros.lab.report.series import SIZES, Series, series_of
from dopslam_ros.lab.study.results import Case as StudyCase
from dopslam_ros.lab.study.run import table_row
from dopslam_ros.lab.study.summary import CONFIDENCE, Averages, averages_of, nees_band, summary_rows
from dopslam_ros.offline.replay_result import Replay

# Path length comes first among what is measured.
PATH_LENGTH = 0


class Comparison(NamedTuple):
    """Cases beside each other.

    Attributes:
        summary: as it goes into JSON.
        columns: of the curves, by name; those of case number c end with ``_c``.
        same_drives: whether the runs of all cases are filtered from the same measurements, so that
            their differences mean something.
    """

    summary: dict[str, Any]
    columns: Series
    same_drives: bool


def compare(cases: Sequence[Case]) -> Comparison:
    """Numbers and curves of cases with the same number of runs.

    Of the same drives only the steps count that every case has.
    """
    runs = range(len(cases[0].runs))
    same = all(_same_drive([case.runs[number] for case in cases]) for number in runs)
    shared = [_shared_steps([case.runs[number] for case in cases]) for number in runs]
    averages: dict[StudyCase, Averages] = {}
    for case in cases:
        kept = [
            _averages(run, steps if same else _offsets(run))
            for run, steps in zip(case.runs, shared, strict=True)
        ]
        averages[case.label, None] = Averages(
            np.concatenate([of_run.squares for of_run in kept]),
            np.concatenate([of_run.plain for of_run in kept]),
        )
    rows = summary_rows(averages, cases[0].label)
    for row, case in zip(rows, cases, strict=True):
        del row["doppler"]
        row["case"] = row.pop("filter")
        if not same:
            row.pop("to_first", None)
        row |= _others(case)
    summary = {
        "runs": len(runs),
        "same_drives": same,
        "confidence": CONFIDENCE,
        "nees_band": nees_band(len(runs)),
        "rows": rows,
    }
    return Comparison(summary, _curves(cases, reduce(np.intersect1d, shared), same), same)


def _offsets(run: Replay) -> IntArray:
    """(K,) times of the steps since the first of them [ns]."""
    stamps = np.array([output.stamp_ns for output in run.outputs], dtype=np.int64)
    return np.asarray(stamps - stamps[0])


def _shared_steps(runs: Sequence[Replay]) -> IntArray:
    return np.asarray(reduce(np.intersect1d, map(_offsets, runs)))


def _same_drive(runs: Sequence[Replay]) -> bool:
    """Whether the same paths were measured at the steps that all have."""
    steps = _shared_steps(runs)
    heard = []
    for run in runs:
        at = dict(zip(_offsets(run).tolist(), run.outputs, strict=True))
        heard.append([at[step].measurements.values[:, PATH_LENGTH] for step in steps.tolist()])
    return all(
        np.array_equal(ours, theirs, equal_nan=True)
        for others in heard[1:]
        for ours, theirs in zip(heard[0], others, strict=True)
    )


def _averages(run: Replay, steps: IntArray) -> Averages:
    """Of one run, (1, ...) each; where some steps have a truth, of these."""
    kept = np.isin(_offsets(run), steps)
    table = np.array([table_row(record, math.nan) for record in run.records()])[kept]
    judged = np.isfinite(table[:, 0])
    return averages_of(table[judged][None] if judged.any() else table[None])


def _others(case: Case) -> dict[str, Any]:
    """What has no interval."""
    seconds = [output.step_seconds for run in case.runs for output in run.outputs]
    problems: dict[str, int] = {}
    for run in case.runs:
        for reason, count in run.problems.items():
            problems[reason] = problems.get(reason, 0) + count
    return {
        "steps": [len(run.outputs) for run in case.runs],
        "step_ms_p50": float(np.median(seconds)) * 1e3,
        "problems": problems,
        "damage": [run.damage for run in case.runs if run.damage],
    }


# --- curves --------------------------------------------------------------------------------------


def _curves(cases: Sequence[Case], steps: IntArray, same: bool) -> Series:
    """Over the runs of each case at the steps that all runs have, and the tracks of the first."""
    columns: Series = {"time": steps / 1e9}
    every = [[_kept(run, steps) for run in case.runs] for case in cases]
    for number, runs in enumerate(every):
        columns |= _case_curves(number, _stacked(runs))
        if same and number:
            columns |= _differences(number, _stacked(runs), _stacked(every[0]))
        track = [output.state.ue_mean for output in cases[number].runs[0].outputs]
        columns[f"x_{number}"], columns[f"y_{number}"] = np.array(track)[:, [X, Y]].T
    first = cases[0].runs[0]
    truth = [first.truth[o.stamp_ns] for o in first.outputs if o.stamp_ns in first.truth]
    states = np.array(truth).reshape(-1, len(VEHICLE))
    low, high = nees_band(len(cases[0].runs))
    return {
        **columns,
        "nees_low": np.full(len(steps), low),
        "nees_high": np.full(len(steps), high),
        "true_x": states[:, X],
        "true_y": states[:, Y],
    }


def _kept(run: Replay, steps: IntArray) -> Series:
    kept = np.isin(_offsets(run), steps)
    return {name: values[kept] for name, values in series_of(run).items()}


def _stacked(runs: Sequence[Series]) -> Series:
    """(runs, K) by name."""
    return {name: np.array([run[name] for run in runs]) for name in runs[0]}


def _case_curves(number: int, runs: Series) -> Series:
    means = ("nees", "va_distance", "sp_distance")
    roots = [f"{kind}_{size}" for kind in ("error", "bound") for size in SIZES]
    return {
        **{f"{name}_{number}": np.sqrt(np.mean(runs[name] ** 2, axis=0)) for name in roots},
        **{f"{name}_{number}": runs[name].mean(axis=0) for name in means},
        f"milliseconds_{number}": np.median(runs["milliseconds"], axis=0),
    }


def _differences(number: int, ours: Series, theirs: Series) -> Series:
    """Of the magnitudes of the errors of the same runs, with the interval of their mean."""
    columns: Series = {}
    for size in SIZES:
        mean, half = _mean_and_half_width(ours[f"error_{size}"] - theirs[f"error_{size}"])
        columns[f"less_{size}_{number}"] = mean
        columns[f"less_low_{size}_{number}"] = mean - half
        columns[f"less_high_{size}_{number}"] = mean + half
    return columns


def _mean_and_half_width(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean (K,) over runs (runs, K), and how far its CONFIDENCE interval reaches; NaN from one."""
    count = len(values)
    mean = values.mean(axis=0)
    if count < 2:
        return mean, np.full(mean.shape, np.nan)
    quantile = student_t(0.5 + CONFIDENCE / 2.0, count - 1)
    return mean, quantile * values.std(axis=0, ddof=1) / math.sqrt(count)
