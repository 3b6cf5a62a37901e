"""A measurement set as arrays, and the checks it must pass before the filter sees it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dopslam_ros.core.linalg.arrays import FloatArray, IntArray
from dopslam_ros.core.models.channel_kernels import wrap_azimuths
from dopslam_ros.core.models.refusal import Refused
from dopslam_ros.core.settings.layout import BS_ID, COMPONENTS, DIM

# Magnitudes beyond which a number cannot be a measurement of its kind [m, rad, ..., m/s].
PLAUSIBLE = np.array([1e7, 2 * np.pi, np.pi, 2 * np.pi, np.pi, 1e5])
# Variances beyond these belong to no receiver, and would spoil the arithmetic.
LEAST_VARIANCE, MOST_VARIANCE = 1e-18, 1e18
# More paths than channel estimators resolve. Each may begin a landmark: with ten times as many a
# step would take seconds and gigabytes.
MOST_PATHS = 1000


class InvalidMeasurements(Refused):
    """A measurement set that must not reach the filter."""


@dataclass(frozen=True)
class MeasurementSet:
    """The paths of one snapshot, in no particular order.

    Attributes:
        values: (J, 6) measured components; NaN where not measured.
        covariances: (J, 6, 6) their covariance, zero where not measured; all zero for a path that
            leaves it to the filter.
        base_station: (J,) id of the base station that each path came from; by default the only one.
    """

    values: FloatArray
    covariances: FloatArray
    base_station: IntArray = None  # type: ignore[assignment]  # as many as there are paths

    def __post_init__(self) -> None:
        if self.base_station is None:
            object.__setattr__(self, "base_station", np.full(len(self.values), BS_ID))

    def __len__(self) -> int:
        return len(self.values)


def checked_measurements(values: FloatArray, covariances: FloatArray) -> MeasurementSet:
    """A measurement set whose every number can be used.

    Args:
        values: (J, 6) in the order of channel.COMPONENTS; NaN where not measured.
        covariances: (J, 6, 6).

    Raises:
        InvalidMeasurements: infinite or impossible values, a path without any component, a
            covariance that is not finite, symmetric and positive definite over what was measured.
    """
    if len(values) > MOST_PATHS:
        raise InvalidMeasurements(
            "too_many_paths", f"{len(values)} paths in a set: at most {MOST_PATHS} can be used"
        )
    _check_values(values)
    stated = np.zeros((len(values), DIM, DIM))
    if covariances.any():  # otherwise all is left to the filter
        _check_covariances(values, covariances)
        measured = np.isfinite(values)
        np.copyto(stated, covariances, where=measured[:, :, None] & measured[:, None, :])
    wrapped = np.array(values, dtype=np.float64, order="C")
    wrap_azimuths(wrapped)
    return MeasurementSet(wrapped, stated)


def _check_values(values: FloatArray) -> None:
    empty = np.isnan(values).all(axis=1)
    if empty.any():
        raise InvalidMeasurements(
            "nothing_measured", f"path {int(np.argmax(empty))} has only NaN: leave it out"
        )
    wrong = np.abs(values) > PLAUSIBLE
    if wrong.any():
        path, component = np.argwhere(wrong)[0]
        name, value = COMPONENTS[component], values[path, component]
        raise InvalidMeasurements(
            "implausible_value",
            f"{name} of path {path} is {value:g}: beyond +-{PLAUSIBLE[component]:g};"
            " NaN says 'not measured'",
        )


def _check_covariances(values: FloatArray, covariances: FloatArray) -> None:
    measured = np.isfinite(values)
    both = measured[:, :, None] & measured[:, None, :]
    given = (both & (covariances != 0.0)).any(axis=(1, 2))
    used = np.where(both, covariances, np.eye(DIM))
    finite = np.isfinite(used).all(axis=(1, 2))
    if not finite.all():
        raise InvalidMeasurements(
            "covariance_not_finite",
            f"covariance of path {int(np.argmin(finite))} has NaN or infinity where a component"
            " was measured",
        )
    std = np.sqrt(np.abs(np.diagonal(used, axis1=1, axis2=2)))
    skew = np.abs(used - np.swapaxes(used, 1, 2))
    symmetric = (skew <= 1e-6 * std[:, :, None] * std[:, None, :]).all(axis=(1, 2))
    if not symmetric.all():
        raise InvalidMeasurements(
            "covariance_not_symmetric",
            f"covariance of path {int(np.argmin(symmetric))} is not symmetric",
        )
    variance = np.diagonal(used, axis1=1, axis2=2)[given]
    sane = (variance > LEAST_VARIANCE) & (variance < MOST_VARIANCE)
    odd = ((variance > 0.0) & ~sane).any(axis=1)
    if odd.any():
        path = np.flatnonzero(given)[int(np.argmax(odd))]
        raise InvalidMeasurements(
            "covariance_implausible",
            f"covariance of path {path} has variances outside {LEAST_VARIANCE:g} .."
            f" {MOST_VARIANCE:g}: give what the estimator really achieves",
        )
    smallest = np.array([_smallest_correlation(matrix) for matrix in used[given]])
    if (smallest <= 1e-9).any():
        path = np.flatnonzero(given)[int(np.argmin(smallest))]
        raise InvalidMeasurements(
            "covariance_not_positive_definite",
            f"covariance of path {path} is not positive definite; all zero leaves it to the"
            " filter's parameter",
        )


def _smallest_correlation(covariance: FloatArray) -> float:
    """Smallest eigenvalue of the correlation matrix: does not depend on the units."""
    variance = np.diagonal(covariance)
    if (variance <= 0.0).any():
        return 0.0
    std = np.sqrt(variance)
    return float(np.linalg.eigvalsh(covariance / np.outer(std, std))[0])
