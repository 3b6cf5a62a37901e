"""How well each path fits each landmark component: the local weights of the PMB update."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.stats import chi2

from dopslam_ros.core.arrays import BoolArray, FloatArray
from dopslam_ros.core.channel import DIM, residual
from dopslam_ros.core.filter.state import UE, FilterParameters, FilterState
from dopslam_ros.core.kernels import evidence as kernels
from dopslam_ros.core.measurements import MeasurementSet

LOG_2PI = float(np.log(2.0 * np.pi))


@dataclass(frozen=True)
class Observed:
    """A measurement set prepared for linear algebra.

    Components that were not measured, or are not used, get a zero innovation, zero Jacobian rows
    and unit variance: they drop out of every density without a special case.

    Attributes:
        values: (J, 6), NaN where not measured or not used.
        used: (J, 6) which components count.
        noise: (J, 6, 6) covariance R, unit where not used.
    """

    values: FloatArray
    used: BoolArray
    noise: FloatArray


@dataclass(frozen=True)
class Evidence:
    """Each path against the BS (source 0) and the components (sources 1 ... C).

    Attributes:
        ue_jacobian: (C + 1, 6, 4) A = dh/ds.
        landmark_jacobian: (C + 1, 6, 3) B = dh/dq; of no meaning for the BS.
        detection: (C + 1,) p_D.
        innovation: (C + 1, J, 6) z - h, zero where not used.
        log_likelihood: (C + 1, J) ln N(z; h, S); -inf outside the gate.
    """

    ue_jacobian: FloatArray
    landmark_jacobian: FloatArray
    detection: FloatArray
    innovation: FloatArray
    log_likelihood: FloatArray


def prepare(measurements: MeasurementSet, parameters: FilterParameters) -> Observed:
    """Fills in the parameter's covariance where a path has none and masks what is not used."""
    count = len(measurements)
    values, used = np.empty((count, DIM)), np.empty((count, DIM), np.bool_)
    noise = np.empty((count, DIM, DIM))
    kernels.prepare(
        np.ascontiguousarray(measurements.values, dtype=np.float64),
        np.ascontiguousarray(measurements.covariances, dtype=np.float64),
        parameters.used_components,
        parameters.noise,
        values,
        used,
        noise,
    )
    return Observed(values, used, noise)


def masked_residual(observed: Observed, expected: FloatArray) -> FloatArray:
    """z - h (..., J, 6) for h (..., J or 1, 6), zero where not used."""
    return np.asarray(np.nan_to_num(residual(observed.values, expected), nan=0.0))


def log_normaliser(observed: Observed) -> FloatArray:
    """(J,) d ln(2 pi) with d the number of components that count."""
    return np.asarray(observed.used.sum(axis=1) * LOG_2PI)


def weigh(
    state: FilterState, observed: Observed, speed: float, parameters: FilterParameters
) -> Evidence:
    """Local likelihoods N(z_j; h_i, S_i) with S = A P A' + B P B' + cross terms + R.

    Args:
        state: predicted.
        observed: J paths.
        speed: v at the snapshot [m/s].
        parameters: gate, p_D and noise.
    """
    sources = len(state.component_track) + 1
    a, b = np.empty((sources, DIM, UE)), np.empty((sources, DIM, 3))
    degenerate, detection = np.empty(sources, np.bool_), np.empty(sources)
    expected, projected = np.empty((sources, DIM)), np.empty((sources, DIM, DIM))
    kernels.look_at_sources(
        state.mean,
        state.covariance,
        state.origin,
        state.axes,
        state.component_type,
        speed,
        parameters.bs,
        parameters.ue_height,
        parameters.detection_probability,
        parameters.sp_field_of_view,
        expected,
        a,
        b,
        degenerate,
        detection,
        projected,
    )
    shape = (sources, len(observed.values))
    innovation, log_likelihood = np.empty((*shape, DIM)), np.empty(shape)
    if not kernels.log_likelihoods(
        projected,
        expected,
        degenerate,
        observed.values,
        observed.used,
        observed.noise,
        gates(parameters.gate_probability),
        innovation,
        log_likelihood,
    ):
        raise np.linalg.LinAlgError("an innovation's covariance is not positive definite")
    return Evidence(
        ue_jacobian=a,
        landmark_jacobian=b,
        detection=detection,
        innovation=innovation,
        log_likelihood=log_likelihood,
    )


@cache
def gates(probability: float) -> FloatArray:
    """(7,) squared Mahalanobis distances inside which a path lies, by its number of components."""
    return np.asarray(chi2.ppf(probability, np.arange(DIM + 1)))


def gaussian_terms(covariance: FloatArray, vector: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Squared Mahalanobis distance and ln det of stacks (..., d, d) and (..., d)."""
    factor = np.linalg.cholesky(covariance)
    white = np.linalg.solve(factor, vector[..., None])[..., 0]
    diagonal = np.diagonal(factor, axis1=-2, axis2=-1)
    return np.sum(white**2, axis=-1), 2.0 * np.sum(np.log(diagonal), axis=-1)
