"""Innovations and densities of stacks of paths, for the filters that are written in NumPy."""

from __future__ import annotations

import math

import numpy as np

from dopslam_ros.core.linalg.arrays import FloatArray
from dopslam_ros.core.models.channel import residual
from dopslam_ros.core.pmb.likelihood import Observed

LOG_2PI = math.log(2.0 * math.pi)


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
