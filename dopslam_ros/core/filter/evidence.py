"""How well each path fits each landmark component: the local weights of the PMB update."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.stats import chi2

from dopslam_ros.core.arrays import BoolArray, FloatArray, IntArray
from dopslam_ros.core.channel import DIM, LandmarkType, observe, residual
from dopslam_ros.core.filter.state import UE, FilterParameters, FilterState
from dopslam_ros.core.kernels import evidence as kernels
from dopslam_ros.core.measurements import MeasurementSet
from dopslam_ros.core.model import detection_probabilities

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
    positions = np.vstack([parameters.bs, state.positions])
    types = np.concatenate([[int(LandmarkType.BS)], state.component_type]).astype(np.int64)
    paths = observe(state.ue_mean, speed, positions, types, parameters.bs, parameters.ue_height)
    to_position = np.concatenate([np.zeros((1, 3, 3)), state.position_jacobians])
    b = paths.landmark_jacobian @ to_position
    ue = np.append(state.ue_mean[:2], parameters.ue_height)
    spread = _distance_std(state, positions - ue, to_position)
    detection = detection_probabilities(parameters, ue, positions, types, spread)
    detection = np.where(paths.degenerate, 0.0, detection)

    projected = _projected_covariance(state, paths.ue_jacobian, b)
    shape = (len(positions), len(observed.values))
    innovation, log_likelihood = np.empty((*shape, DIM)), np.empty(shape)
    if not kernels.log_likelihoods(
        projected,
        paths.mean,
        paths.degenerate,
        observed.values,
        observed.used,
        observed.noise,
        gates(parameters.gate_probability),
        innovation,
        log_likelihood,
    ):
        raise np.linalg.LinAlgError("an innovation's covariance is not positive definite")
    return Evidence(
        ue_jacobian=paths.ue_jacobian,
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


def _projected_covariance(state: FilterState, a: FloatArray, b: FloatArray) -> FloatArray:
    """(C + 1, d, d) covariance of h (C + 1, d), or of anything with Jacobians A and B, without R.

    A (C + 1, d, 4) and B (C + 1, d, 3); B of source 0, the BS, does not count.
    """
    projected = np.empty((len(a), a.shape[1], a.shape[1]))
    kernels.project(a, b, state.covariance, projected)
    return projected


def _distance_std(state: FilterState, offset: FloatArray, to_position: FloatArray) -> FloatArray:
    """(C + 1,) standard deviation of the distance to each source [m], to first order.

    Args:
        state: predicted.
        offset: (C + 1, 3) from the vehicle to the sources [m].
        to_position: (C + 1, 3, 3) derivatives of their positions with respect to q.
    """
    direction = offset / np.maximum(np.linalg.norm(offset, axis=1), 1e-6)[:, None]
    a = np.zeros((len(offset), 1, UE))
    a[:, 0, :2] = -direction[:, :2]
    variance = _projected_covariance(state, a, direction[:, None, :] @ to_position)
    return np.asarray(np.sqrt(np.maximum(variance[:, 0, 0], 0.0)))


def source_tracks(state: FilterState) -> IntArray:
    """(C + 1,) the row of the association problem each source belongs to: 0 the BS, then tracks."""
    return np.concatenate([[0], state.component_track + 1]).astype(np.int64)
