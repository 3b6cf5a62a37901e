"""The paths of a set as the filters take them, and what they differ in from what was expected."""

from __future__ import annotations

import numpy as np

from dopslam_ros.core.linalg.arrays import FloatArray, floats
from dopslam_ros.core.models.channel import residual
from dopslam_ros.core.models.measurements import MeasurementSet
from dopslam_ros.core.pmb import likelihood as kernels
from dopslam_ros.core.pmb.likelihood import Observed
from dopslam_ros.core.settings.filtering import FilterParameters

LOG_2PI = float(np.log(2.0 * np.pi))


def prepare(measurements: MeasurementSet, parameters: FilterParameters) -> Observed:
    """Fills in the parameter's covariance where a path has none and masks what is not used."""
    return kernels.prepare(
        floats(measurements.values),
        floats(measurements.covariances),
        parameters.used_components,
        parameters.noise,
    )


def masked_residual(observed: Observed, expected: FloatArray) -> FloatArray:
    """z - h (..., J, 6) for h (..., J or 1, 6), zero where not used."""
    return np.asarray(np.nan_to_num(residual(observed.values, expected), nan=0.0))


def log_normaliser(observed: Observed) -> FloatArray:
    """(J,) d ln(2 pi) with d the number of components that count."""
    return np.asarray(observed.used.sum(axis=1) * LOG_2PI)


def gaussian_terms(covariance: FloatArray, vector: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Squared Mahalanobis distance and ln det of stacks (..., d, d) and (..., d)."""
    factor = np.linalg.cholesky(covariance)
    white = np.linalg.solve(factor, vector[..., None])[..., 0]
    diagonal = np.diagonal(factor, axis1=-2, axis2=-1)
    return np.sum(white**2, axis=-1), 2.0 * np.sum(np.log(diagonal), axis=-1)
