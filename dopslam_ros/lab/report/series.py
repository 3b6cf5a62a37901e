"""A run as numbers over its steps, by name: what the charts of a page draw."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TypeAlias

import numpy as np

from dopslam_ros.core.linalg.arrays import FloatArray
from dopslam_ros.core.linalg.quantiles import chi_square
from dopslam_ros.core.session.output import FilterOutput
from dopslam_ros.core.settings.layout import CLOCK_BIAS, HEADING, VEHICLE, X, Y
from dopslam_ros.offline.evaluation import StepRecord
from dopslam_ros.offline.replay_result import Replay

Series: TypeAlias = dict[str, FloatArray]

CONFIDENCE = 0.95
UE_DIMENSION = len(VEHICLE)
# One standard deviation and error of a state (x, y, heading, clock bias) as three numbers.
SIZES = ("position", "heading", "clock")
SCALES = (1.0, math.degrees(1.0), 1.0)


def series_of(run: Replay) -> Series:
    """Everything that has one number a step, (K,) each; NaN where it is not known.

    Returns:
        time: since the first snapshot [s].
        error_..., sigma_..., bound_..., plain_bound_...: of position [m], heading [deg] and clock
            [m]: the error's magnitude, the filter's standard deviation, the bounds with everything
            measured and without Doppler.
        va_..., sp_...: GOSPA distance and the roots of its parts [m].
        nees, nees_low, nees_high, nis, nis_low, nis_high: with the band that holds an honest one
            with CONFIDENCE; the NIS divided by its degrees of freedom.
        weight_best, weight_second, weight_rest: of the associations.
        milliseconds: that the step took.
    """
    stamps = np.array([output.stamp_ns for output in run.outputs], dtype=np.int64)
    seconds = (stamps - stamps[:1]) / 1e9
    records = run.records()
    return {
        "time": seconds,
        **_sizes("error", _magnitudes(_rows([r.error for r in records], 4))),
        **_sizes("sigma", _sigmas(run.outputs)),
        **_sizes("bound", _rows([r.bound for r in records], 3)),
        **_sizes("plain_bound", _bounds_without_doppler(run)),
        **_gospa(records),
        **_consistency(run.outputs, records),
        **_weights(run.outputs),
        "milliseconds": np.array([output.step_seconds * 1e3 for output in run.outputs]),
    }


def _rows(found: Sequence[FloatArray], width: int) -> FloatArray:
    return np.array(found, dtype=np.float64).reshape(-1, width)


def _sizes(name: str, values: FloatArray) -> Series:
    """Columns (K, 3) by name, the heading in degrees."""
    scaled = values * np.array(SCALES)
    return {f"{name}_{size}": scaled[:, column] for column, size in enumerate(SIZES)}


def _magnitudes(states: FloatArray) -> FloatArray:
    """(K, 3) magnitudes of position, heading and clock of (K, U)."""
    return np.column_stack(
        [np.hypot(states[:, X], states[:, Y]), np.abs(states[:, [HEADING, CLOCK_BIAS]])]
    )


def _sigmas(outputs: Sequence[FilterOutput]) -> FloatArray:
    """(K, 3) the standard deviations that the filter gives for them."""
    variance = _rows([np.diagonal(o.state.ue_covariance) for o in outputs], UE_DIMENSION)
    return np.sqrt(
        np.column_stack([variance[:, X] + variance[:, Y], variance[:, [HEADING, CLOCK_BIAS]]])
    )


def _bounds_without_doppler(run: Replay) -> FloatArray:
    unknown = np.full(3, np.nan)
    found = [run.bounds.get(output.stamp_ns) for output in run.outputs]
    return _rows([unknown if b is None else np.array(b.without_doppler[:3]) for b in found], 3)


def _gospa(records: Sequence[StepRecord]) -> Series:
    """The roots of the parts, so that all of it is in metres: their squares add up."""
    series: Series = {}
    for kind in ("va", "sp"):
        parts = _rows([np.array(getattr(record, kind)) for record in records], 4)
        parts[:, 1:] = np.sqrt(parts[:, 1:])
        names = ("distance", "localisation", "missed", "false")
        series |= {f"{kind}_{name}": parts[:, i] for i, name in enumerate(names)}
    return series


def _consistency(outputs: Sequence[FilterOutput], records: Sequence[StepRecord]) -> Series:
    nees = np.array([record.nees for record in records], dtype=np.float64)
    nis = np.array([output.associations.nis for output in outputs], dtype=np.float64)
    freedom = np.array([output.associations.nis_dof for output in outputs], dtype=np.float64)
    measured = freedom > 0
    freedom = np.where(measured, freedom, np.nan)
    low, high = band(UE_DIMENSION)
    nis_low, nis_high = band(freedom)
    return {
        "nees": nees,
        "nees_low": np.full(len(nees), low),
        "nees_high": np.full(len(nees), high),
        "nis": nis / freedom,
        "nis_low": np.asarray(nis_low / freedom),
        "nis_high": np.asarray(nis_high / freedom),
    }


def band(freedom: float | FloatArray) -> tuple[FloatArray, FloatArray]:
    """The ends of the interval that holds a chi-square with CONFIDENCE."""
    tail = (1.0 - CONFIDENCE) / 2.0
    return chi_square(tail, freedom), chi_square(1.0 - tail, freedom)


def _weights(outputs: Sequence[FilterOutput]) -> Series:
    top = np.zeros((len(outputs), 2))
    for row, output in zip(top, outputs, strict=True):
        weight = output.associations.weight[:2]
        row[: len(weight)] = weight
    return {
        "weight_best": top[:, 0],
        "weight_second": top[:, 1],
        "weight_rest": np.maximum(1.0 - top.sum(axis=1), 0.0),
    }
