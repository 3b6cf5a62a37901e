"""New landmarks from single paths: where they would be, how sure, and how likely they are new."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dopslam_ros.core.arrays import BoolArray, FloatArray, IntArray, symmetrise
from dopslam_ros.core.channel import Paths, observe
from dopslam_ros.core.filter.evidence import (
    LOG_2PI,
    Observed,
    gaussian_terms,
    log_normaliser,
    masked_residual,
)
from dopslam_ros.core.filter.state import UE, UNKNOWN_TYPES, FilterParameters, FilterState
from dopslam_ros.core.filter.undetected import log_share_left
from dopslam_ros.core.model import detection_probabilities

GAUSS_NEWTON_STEPS = 6
# Worse known than this [m] a new landmark is of no use, and its linearisation no good.
LARGEST_STD = 200.0


@dataclass(frozen=True)
class Births:
    """A candidate landmark of each unknown type (first axis, 2) from each path (second, J).

    Attributes:
        position: (2, J, 3) [m].
        covariance: (2, J, 3, 3).
        gain: (2, J, 3, 4) how the position follows the vehicle: its covariance with any part y of
            the state is ``gain @ cov(s, y)``.
        log_intensity: (2, J) ln rho, the measurement intensity of undetected landmarks; -inf where
            the path cannot have come from such a landmark.
    """

    position: FloatArray
    covariance: FloatArray
    gain: FloatArray
    log_intensity: FloatArray


def propose(
    state: FilterState, observed: Observed, speed: float, parameters: FilterParameters
) -> Births:
    """Fits a landmark of each type to each path, the vehicle being uncertain.

    Starts where the ray of arrival (or of departure) meets the ellipsoid of the delay, then
    Gauss-Newton on all measured components. The vehicle's uncertainty counts as measurement noise,
    R + A P A', and comes back as the correlation with the vehicle. rho is the Laplace approximation
    of the integral of lambda p_D N(z; h(x, s), R) over x and s.

    Args:
        state: predicted.
        observed: J paths.
        speed: v at the snapshot [m/s].
        parameters: intensities and the height prior.
    """
    count = len(observed.values)
    start, located = initial_incidence_points(state.ue_mean, observed, parameters)
    shape = (len(UNKNOWN_TYPES), count)
    types = np.repeat(UNKNOWN_TYPES, count).astype(np.int64)
    both = _repeat(observed)
    position = np.vstack([_virtual_anchors(state.ue_mean, start, parameters), start])
    for _ in range(GAUSS_NEWTON_STEPS):
        fit = _linearise(state, both, speed, position, types, parameters)
        # One cautious step must not leave the region where the linearisation means something.
        length = np.linalg.norm(fit.step, axis=1, keepdims=True)
        position = position + fit.step * np.minimum(1.0, LARGEST_STD / np.maximum(length, 1e-9))
    fit = _linearise(state, both, speed, position, types, parameters)

    ue = np.append(state.ue_mean[:2], parameters.ue_height)
    offset = position - ue
    direction = offset / np.maximum(np.linalg.norm(offset, axis=1), 1e-6)[:, None]
    spread = np.sqrt(np.einsum("mi,mij,mj->m", direction, fit.covariance, direction))
    detection = detection_probabilities(parameters, ue, position, types, spread)
    known = np.trace(fit.covariance, axis1=1, axis2=2) < LARGEST_STD**2
    good = np.tile(located, 2) & known & fit.paths.facing & (detection > 0.0)
    log_intensity = (
        np.log(parameters.undetected_intensity)
        + log_share_left(
            state.undetected, position, types, spread, parameters, parameters.undetected_floor
        )
        + np.log(np.where(good, detection, 1.0))
        + 0.5 * (3.0 * LOG_2PI - fit.log_information)
        - 0.5 * (fit.mismatch + fit.log_noise + log_normaliser(both))
    )
    return Births(
        position=position.reshape(*shape, 3),
        covariance=fit.covariance.reshape(*shape, 3, 3),
        gain=fit.gain.reshape(*shape, 3, UE),
        log_intensity=np.where(good, log_intensity, -np.inf).reshape(shape),
    )


def initial_incidence_points(
    ue_state: FloatArray, observed: Observed, parameters: FilterParameters
) -> tuple[FloatArray, BoolArray]:
    """Where the paths touched the world, from few of their components.

    With a path length: along the ray of arrival, or else of departure, up to the ellipsoid of the
    length (foci vehicle and BS); a missing elevation is taken from the prior height. Without: where
    the rays of arrival and departure pass closest.

    Args:
        ue_state: (4,) the vehicle.
        observed: J paths.
        parameters: BS, heights.

    Returns:
        (J, 3) points [m] and (J,) whether the path can be located at all.
    """
    ue = np.append(ue_state[:2], parameters.ue_height)
    bs = parameters.bs
    z = observed.values
    has = np.isfinite(z)
    length = np.where(has[:, 0], z[:, 0], 0.0) - ue_state[3]
    from_ue = _ellipsoid_point(ue, bs, z[:, 1] + ue_state[2], z[:, 2], length, parameters)
    from_bs = _ellipsoid_point(bs, ue, z[:, 3], z[:, 4], length, parameters)
    crossing = _closest_point(ue, bs, z[:, 1] + ue_state[2], z[:, 2], z[:, 3], z[:, 4])

    arrival = has[:, 1] & (has[:, 2] | ~has[:, 4] | ~has[:, 3])
    departure = has[:, 3] & ~arrival
    points = np.select(
        [(has[:, 0] & arrival)[:, None], (has[:, 0] & departure)[:, None]],
        [from_ue, from_bs],
        crossing,
    )
    direct = float(np.linalg.norm(bs - ue))
    located = np.where(has[:, 0], (arrival | departure) & (length > direct), has[:, 1] & has[:, 3])
    located = located & np.isfinite(points).all(axis=1)
    return np.where(located[:, None], points, ue + np.array([1.0, 1.0, 1.0])), located


@dataclass(frozen=True)
class _Fit:
    """Normal equations of the positions at one iterate; M candidates."""

    paths: Paths
    step: FloatArray
    covariance: FloatArray
    gain: FloatArray
    log_information: FloatArray
    log_noise: FloatArray
    mismatch: FloatArray


def _linearise(
    state: FilterState,
    observed: Observed,
    speed: float,
    position: FloatArray,
    types: IntArray,
    parameters: FilterParameters,
) -> _Fit:
    paths = observe(state.ue_mean, speed, position, types, parameters.bs, parameters.ue_height)
    innovation = masked_residual(observed, paths.mean)
    a = paths.ue_jacobian * observed.used[:, :, None]
    b = paths.landmark_jacobian * observed.used[:, :, None]
    noise = symmetrise(observed.noise + a @ state.ue_covariance @ np.swapaxes(a, 1, 2))
    weighted = np.swapaxes(np.linalg.solve(noise, b), 1, 2)  # B' (R + A P A')^-1
    prior = np.diag([1e-12, 1e-12, parameters.landmark_height_std**-2])
    off_prior = np.zeros_like(position)
    off_prior[:, 2] = parameters.landmark_height_mean - position[:, 2]
    information = symmetrise(weighted @ b + prior)
    right = (weighted @ innovation[:, :, None])[:, :, 0] + off_prior @ prior
    covariance = symmetrise(np.asarray(np.linalg.solve(information, np.eye(3)[None]), np.float64))
    mismatch, log_noise = gaussian_terms(noise, innovation)
    return _Fit(
        paths=paths,
        step=(covariance @ right[:, :, None])[:, :, 0],
        covariance=covariance,
        gain=-covariance @ weighted @ a,
        log_information=np.linalg.slogdet(information)[1],
        log_noise=log_noise,
        mismatch=mismatch + np.einsum("mi,ij,mj->m", off_prior, prior, off_prior),
    )


def _repeat(observed: Observed) -> Observed:
    """Each path once per unknown type."""
    times = len(UNKNOWN_TYPES)
    return Observed(
        np.tile(observed.values, (times, 1)),
        np.tile(observed.used, (times, 1)),
        np.tile(observed.noise, (times, 1, 1)),
    )


def _virtual_anchors(
    ue_state: FloatArray, incidence: FloatArray, parameters: FilterParameters
) -> FloatArray:
    """(J, 3) the VAs whose paths touch their wall at the incidence points (J, 3)."""
    ue = np.append(ue_state[:2], parameters.ue_height)
    to_point = incidence - ue
    first = np.linalg.norm(to_point, axis=1, keepdims=True)
    second = np.linalg.norm(incidence - parameters.bs, axis=1, keepdims=True)
    return np.asarray(incidence + to_point * second / np.maximum(first, 1e-6))


def _direction(azimuth: FloatArray, elevation: FloatArray) -> FloatArray:
    """(J, 3) unit vectors."""
    ground = np.cos(elevation)
    return np.stack([ground * np.cos(azimuth), ground * np.sin(azimuth), np.sin(elevation)], axis=1)


def _ellipsoid_point(
    focus: FloatArray,
    other: FloatArray,
    azimuth: FloatArray,
    elevation: FloatArray,
    length: FloatArray,
    parameters: FilterParameters,
) -> FloatArray:
    """(J, 3) where rays from one focus meet the ellipsoid of points with that sum of distances."""
    unknown = np.isnan(elevation)
    elevation = np.where(unknown, 0.0, elevation)
    offset = focus - other
    point = np.full((len(length), 3), np.nan)
    for _ in range(10):  # settles the elevation towards the prior height where it is unknown
        direction = _direction(azimuth, elevation)
        denominator = length + direction @ offset
        reach = (
            0.5
            * (length**2 - offset @ offset)
            / np.where(np.abs(denominator) < 1e-6, np.nan, denominator)
        )
        point = focus + reach[:, None] * direction
        if not unknown.any():
            break
        rise = parameters.landmark_height_mean - focus[2]
        ratio = np.clip(rise / np.maximum(np.nan_to_num(reach, nan=1.0), 1.0), -0.9, 0.9)
        elevation = np.where(unknown, np.arcsin(ratio), elevation)
    return point


def _closest_point(
    ue: FloatArray,
    bs: FloatArray,
    arrival_azimuth: FloatArray,
    arrival_elevation: FloatArray,
    departure_azimuth: FloatArray,
    departure_elevation: FloatArray,
) -> FloatArray:
    """(J, 3) midpoint where the rays of arrival and departure pass closest; NaN if parallel."""
    u = _direction(arrival_azimuth, np.nan_to_num(arrival_elevation, nan=0.0))
    w = _direction(departure_azimuth, np.nan_to_num(departure_elevation, nan=0.0))
    baseline = bs - ue
    cosine = np.einsum("ji,ji->j", u, w)
    sine = 1.0 - cosine**2
    sine = np.where(sine < 1e-4, np.nan, sine)
    along_u = (u @ baseline - cosine * (w @ baseline)) / sine
    along_w = (cosine * (u @ baseline) - w @ baseline) / sine
    ahead = (along_u > 0.0) & (along_w > 0.0)
    middle = 0.5 * (ue + along_u[:, None] * u + bs + along_w[:, None] * w)
    return np.where(ahead[:, None], middle, np.nan)
