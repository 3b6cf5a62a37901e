"""How well each path fits each landmark component: the local weights of the PMB update."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from dopslam_ros.core.arrays import BoolArray, FloatArray, IntArray, symmetrise
from dopslam_ros.core.channel import DIM, LandmarkType, Paths, observe, residual
from dopslam_ros.core.filter.state import FilterParameters, FilterState
from dopslam_ros.core.measurements import MeasurementSet
from dopslam_ros.core.model import detection_probabilities

LOG_2PI = float(np.log(2.0 * np.pi))
# Below this [m] a quadratic says nothing of a length; keeps the curvature finite.
CLOSEST = 1.0


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
        paths: h and Jacobians of the C + 1 sources.
        detection: (C + 1,) p_D.
        innovation: (C + 1, J, 6) z - E[h], zero where not used.
        curvature: (C + 1,) variance of the path length that is not in A P A' + B P B' [m^2].
        log_likelihood: (C + 1, J) ln N(z; h, S); -inf outside the gate.
    """

    paths: Paths
    detection: FloatArray
    innovation: FloatArray
    curvature: FloatArray
    log_likelihood: FloatArray


def prepare(measurements: MeasurementSet, parameters: FilterParameters) -> Observed:
    """Fills in the parameter's covariance where a path has none and masks what is not used."""
    used = measurements.measured & parameters.used_components
    given = (measurements.covariances != 0.0).any(axis=(1, 2))
    noise = np.where(given[:, None, None], measurements.covariances, parameters.noise)
    both = used[:, :, None] & used[:, None, :]
    return Observed(
        values=np.where(used, measurements.values, np.nan),
        used=used,
        noise=symmetrise(np.where(both, noise, np.eye(DIM))),
    )


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

    For the path length S has a second-order term too: a young landmark is known to 0.1 m along the
    ray and to 10 m across it, so that the bend of the sphere of equal length counts for more than
    the noise. Without it the filter believes what it cannot know.

    Args:
        state: predicted.
        observed: J paths.
        speed: v at the snapshot [m/s].
        parameters: gate, p_D and noise.
    """
    positions = np.vstack([parameters.bs, state.positions])
    types = np.concatenate([[int(LandmarkType.BS)], state.component_type]).astype(np.int64)
    paths = observe(state.ue_mean, speed, positions, types, parameters.bs, parameters.ue_height)
    innovation_covariance = _projected_covariance(state, paths)
    relative = _relative_covariance(state)
    ue = np.append(state.ue_mean[:2], parameters.ue_height)
    spread = _distance_std(positions - ue, relative)
    shift, curvature = _path_length_curvature(state, positions, types, relative, parameters)
    detection = detection_probabilities(parameters, ue, positions, types, spread)
    detection = np.where(paths.degenerate, 0.0, detection)

    both = observed.used[:, :, None] & observed.used[:, None, :]
    innovation_covariance[:, 0, 0] += curvature
    s = np.where(both, innovation_covariance[:, None], 0.0) + observed.noise
    expected = paths.mean.copy()
    expected[:, 0] += shift
    innovation = masked_residual(observed, expected[:, None, :])
    mahalanobis, log_determinant = gaussian_terms(s, innovation)
    log_likelihood = -0.5 * (mahalanobis + log_determinant + log_normaliser(observed))
    gate = chi2.ppf(parameters.gate_probability, observed.used.sum(axis=1))
    inside = (mahalanobis <= gate) & ~paths.degenerate[:, None]
    return Evidence(
        paths=paths,
        detection=detection,
        innovation=innovation,
        curvature=curvature,
        log_likelihood=np.where(inside, log_likelihood, -np.inf),
    )


def gaussian_terms(covariance: FloatArray, vector: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Squared Mahalanobis distance and ln det of stacks (..., d, d) and (..., d)."""
    factor = np.linalg.cholesky(covariance)
    white = np.linalg.solve(factor, vector[..., None])[..., 0]
    diagonal = np.diagonal(factor, axis1=-2, axis2=-1)
    return np.sum(white**2, axis=-1), 2.0 * np.sum(np.log(diagonal), axis=-1)


def _projected_covariance(state: FilterState, paths: Paths) -> FloatArray:
    """(C + 1, 6, 6) covariance of h from what is uncertain in the state, without R."""
    a, b = paths.ue_jacobian, paths.landmark_jacobian[1:]
    projected = a @ state.ue_covariance @ np.swapaxes(a, 1, 2)
    cross = a[1:] @ state.cross_covariances @ np.swapaxes(b, 1, 2)
    projected[1:] += b @ state.position_covariances @ np.swapaxes(b, 1, 2)
    projected[1:] += cross + np.swapaxes(cross, 1, 2)
    return symmetrise(projected)


def _relative_covariance(state: FilterState) -> FloatArray:
    """(C + 1, 3, 3) covariance of the vector from the vehicle to each source [m^2]."""
    covariance = np.zeros((len(state.component_track) + 1, 3, 3))
    covariance[:, :2, :2] = state.ue_covariance[:2, :2]
    cross = np.zeros((len(state.component_track), 3, 3))
    cross[:, :2] = state.cross_covariances[:, :2]
    covariance[1:] += state.position_covariances - cross - np.swapaxes(cross, 1, 2)
    return covariance


def _distance_std(offset: FloatArray, covariance: FloatArray) -> FloatArray:
    """(M,) standard deviation of the length of vectors (M, 3) [m], to first order."""
    direction = offset / np.maximum(np.linalg.norm(offset, axis=1), 1e-6)[:, None]
    variance = np.einsum("mi,mij,mj->m", direction, covariance, direction)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def _path_length_curvature(
    state: FilterState,
    positions: FloatArray,
    types: IntArray,
    relative: FloatArray,
    parameters: FilterParameters,
) -> tuple[FloatArray, FloatArray]:
    """(C + 1,) what second order adds to the mean [m] and to the variance [m^2] of path lengths.

    The quadratic form w' H w / 2 of a Gaussian of covariance P has the mean tr(H P) / 2 and the
    variance tr(H P H P) / 2; two of them, H of w and G of x, have the covariance tr(H C G C') / 2
    with C = cov(w, x). The path of an SP is the sum of two: vehicle to it and BS to it.
    """
    ue = np.append(state.ue_mean[:2], parameters.ue_height)
    leg = np.zeros_like(relative)
    leg[1:] = state.position_covariances
    both = leg.copy()
    both[1:, :2] -= state.cross_covariances[:, :2]
    scattered = types == LandmarkType.SP
    near = _length_hessian(positions - ue)
    far = _length_hessian(positions - parameters.bs) * scattered[:, None, None]
    mean = near @ relative + far @ leg
    crossed = near @ both @ far @ np.swapaxes(both, 1, 2)
    return (
        np.asarray(0.5 * np.trace(mean, axis1=1, axis2=2)),
        _trace_of_square(near @ relative)
        + _trace_of_square(far @ leg)
        + np.trace(crossed, axis1=1, axis2=2),
    )


def _length_hessian(offset: FloatArray) -> FloatArray:
    """(M, 3, 3) second derivative of the lengths of vectors (M, 3): (I - u u') / |w|."""
    length = np.maximum(np.linalg.norm(offset, axis=1), CLOSEST)
    direction = offset / length[:, None]
    across = np.eye(3) - direction[:, :, None] * direction[:, None, :]
    return np.asarray(across / length[:, None, None])


def _trace_of_square(matrices: FloatArray) -> FloatArray:
    """(M,) tr(A A) / 2."""
    return np.asarray(0.5 * np.einsum("mij,mji->m", matrices, matrices))


def source_tracks(state: FilterState) -> IntArray:
    """(C + 1,) the row of the association problem each source belongs to: 0 the BS, then tracks."""
    return np.concatenate([[0], state.component_track + 1]).astype(np.int64)
