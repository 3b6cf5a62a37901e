"""From a single path to a Gaussian landmark: Gauss-Newton and the Laplace approximation.

The position x of a landmark that was never detected is fitted to a path z, the vehicle s being
uncertain: s ~ N(m, P), z = h(x, s) + noise of covariance R, x of a height that is known beforehand.
Linearised, z - h = A (s - m) + B dx + noise, so that with S = R + A P A'

    cov(x) = (B' S^-1 B + prior)^-1,    dx = cov(x) (B' S^-1 (z - h) + prior).

Given z, x depends on the vehicle by dx/ds = -cov(x) B' S^-1 A. Which of these landmarks are kept,
and how they join the density, is in ``newborn``; ``position_fit`` writes the equations down.

Sizes are passed on as ``len(...)``: for literals the callees would be compiled once more each.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dopslam_ros.core.linalg.arrays import FloatArray
from dopslam_ros.core.linalg.jit import jit, jit_inline
from dopslam_ros.core.linalg.small import cholesky, solve_bordered
from dopslam_ros.core.linalg.vec import Vec, between, unit, vec
from dopslam_ros.core.models.channel_kernels import observe_source
from dopslam_ros.core.models.detection_kernels import detection_probability, distance_between
from dopslam_ros.core.models.incidence import incidence_points, to_virtual_anchor
from dopslam_ros.core.pmb.density import Density
from dopslam_ros.core.pmb.likelihood import Observed
from dopslam_ros.core.pmb.position_fit import (
    LARGEST_STD,
    Fit,
    add_prior,
    laplace,
    linearise,
    new_fit,
    position_posterior,
)
from dopslam_ros.core.pmb.undetected_kernels import log_share_left
from dopslam_ros.core.settings.filtering import Constants
from dopslam_ros.core.settings.layout import SPACE, UNKNOWN_TYPES, VA, X, Y

GAUSS_NEWTON_STEPS = 6
# A step of less than this many standard deviations changes nothing any more.
NEGLIGIBLE_STEP = 1e-9


@jit
def propose(density: Density, observed: Observed, speed: float, constants: Constants) -> Births:
    """Fits a landmark of each type to each path, the vehicle being uncertain.

    Starts where the ray of arrival (or of departure) meets the ellipsoid of the delay, then
    Gauss-Newton on all measured components. rho is the Laplace approximation of the integral of
    lambda p_D N(z; h(x, s), R) over x and s, lambda the intensity of eq. (27).

    Args:
        density: predicted.
        observed: J paths.
        speed: v at the snapshot [m/s].
        constants: intensities and the height prior.
    """
    ue, vehicle, paths = density.mean, density.start[0], len(observed.values)
    incidence, located = np.empty((paths, SPACE)), np.empty(paths, np.bool_)
    incidence_points(
        ue,
        constants.ue_height,
        constants.bs,
        constants.landmark_height_mean,
        observed.values,
        incidence,
        located,
    )
    births, fit = no_births(paths, vehicle), new_fit(vehicle)
    for t in range(len(UNKNOWN_TYPES)):
        kind = UNKNOWN_TYPES[t]
        for j in range(paths):
            position, covariance = births.position[t, j], births.covariance[t, j]
            for i in range(SPACE):
                position[i] = incidence[j, i]
            if not located[j]:
                continue
            if kind == VA:
                to_virtual_anchor(ue, constants.ue_height, constants.bs, position)
            if not fit_position(density, observed, j, speed, constants, kind, position, fit):
                continue
            if not position_posterior(fit, covariance, births.gain[t, j]):
                continue
            std = distance_std(ue, constants.ue_height, position, covariance)
            births.log_intensity[t, j] = laplace(fit, observed.used[j]) + log_undetected(
                density, position, kind, std, constants
            )
    return births


@jit_inline
def log_undetected(
    density: Density, position: FloatArray, kind: int, distance_std: float, constants: Constants
) -> float:
    """ln (lambda p_D) of a landmark of a type at a position (3,) [m], its distance being uncertain.

    lambda is the intensity of landmarks that were never detected: what looking there before has
    left of it.
    """
    distance = distance_between(density.mean[X], density.mean[Y], constants.ue_height, position)
    seen = detection_probability(
        kind, distance, distance_std, constants.detection_probability, constants.sp_field_of_view
    )
    if not seen > 0.0:
        return -math.inf
    share = log_share_left(
        density.undetected,
        constants.ue_height,
        position,
        kind,
        distance_std,
        constants.detection_probability,
        constants.sp_field_of_view,
        constants.undetected_floor,
    )
    return constants.log_undetected_intensity + share + math.log(seen)


@jit_inline
def fit_position(
    density: Density,
    observed: Observed,
    j: int,
    speed: float,
    constants: Constants,
    kind: int,
    position: FloatArray,
    fit: Fit,
) -> bool:
    """Gauss-Newton from position (3,) [m], which is moved to the best fit of path j.

    Stops when the step is negligible, the linearisation being as good as the one behind it.

    Returns:
        Whether there may be such a landmark; if so, ``fit`` is that at its position.
    """
    for step in range(GAUSS_NEWTON_STEPS + 1):
        _, facing = observe_source(
            density.mean,
            speed,
            constants.bs,
            constants.ue_height,
            position,
            kind,
            fit.h,
            fit.a,
            fit.b,
        )
        if not linearise(density.covariance, observed, j, fit):
            return False
        height_mean, height_std = constants.landmark_height_mean, constants.landmark_height_std
        add_prior(height_mean, height_std, position[2], fit.normal)
        if not cholesky(fit.normal, len(position)):
            return False
        if step == GAUSS_NEWTON_STEPS:
            break
        # The last row of the bordered equations is their right-hand side, and then the step.
        size = solve_bordered(fit.normal, len(position))
        dx, dy, dz = fit.normal[SPACE, 0], fit.normal[SPACE, 1], fit.normal[SPACE, 2]
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        # One cautious step must not leave the region where the linearisation means something.
        share = 1.0 if length <= LARGEST_STD else LARGEST_STD / length
        for i in range(SPACE):
            position[i] += share * fit.normal[SPACE, i]
        if size < NEGLIGIBLE_STEP * NEGLIGIBLE_STEP:  # in standard deviations, squared
            break
    return facing


@jit
def distance_std(
    ue: FloatArray, ue_height: float, position: FloatArray, covariance: FloatArray
) -> float:
    """Standard deviation [m] of the distance to a position (3,) with covariance (3, 3)."""
    _, (x, y, z) = unit(between(Vec(ue[X], ue[Y], ue_height), vec(position)))
    variance = x * x * covariance[0, 0] + y * y * covariance[1, 1] + z * z * covariance[2, 2]
    cross = x * y * covariance[0, 1] + x * z * covariance[0, 2] + y * z * covariance[1, 2]
    return math.sqrt(max(variance + 2.0 * cross, 0.0))


class Births(NamedTuple):
    """A candidate landmark of each unknown type (first axis, 2) from each path (second, J).

    Where ``log_intensity`` is -inf the rest is finite but means nothing.

    Attributes:
        position: (2, J, 3) [m].
        covariance: (2, J, 3, 3).
        gain: (2, J, 3, S) how the position follows the vehicle: its covariance with any part y of
            the state is ``gain @ cov(s, y)``.
        log_intensity: (2, J) ln rho, the measurement intensity of undetected landmarks; -inf where
            the path cannot have come from such a landmark.
    """

    position: FloatArray
    covariance: FloatArray
    gain: FloatArray
    log_intensity: FloatArray


@jit
def no_births(paths: int, vehicle: int) -> Births:
    """Candidates from so many paths, all impossible so far."""
    types = len(UNKNOWN_TYPES)
    return Births(
        np.empty((types, paths, SPACE)),
        np.zeros((types, paths, SPACE, SPACE)),
        np.zeros((types, paths, SPACE, vehicle)),
        np.full((types, paths), -math.inf),
    )
