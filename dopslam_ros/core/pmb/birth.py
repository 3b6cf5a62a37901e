"""A landmark fitted to a single path: Gauss-Newton and the Laplace approximation.

Sizes are passed on as ``len(...)``: for literals the callees would be compiled once more each.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dopslam_ros.core.linalg.arrays import BoolArray, FloatArray
from dopslam_ros.core.linalg.jit import jit
from dopslam_ros.core.linalg.small import (
    backward,
    cholesky,
    forward,
    forward_columns,
    log_determinant,
    solve_bordered,
)
from dopslam_ros.core.linalg.vec import Vec, between, unit, vec
from dopslam_ros.core.models.channel_kernels import observe_source, wrapped
from dopslam_ros.core.models.detection_kernels import detection_probability, distance_between
from dopslam_ros.core.models.incidence import incidence_points, to_virtual_anchor
from dopslam_ros.core.pmb.density import Density
from dopslam_ros.core.pmb.likelihood import Observed
from dopslam_ros.core.pmb.undetected_kernels import log_share_left
from dopslam_ros.core.settings.filtering import Constants
from dopslam_ros.core.settings.layout import DIM, SP, VA, X, Y

GAUSS_NEWTON_STEPS = 6
# A step of less than this many standard deviations changes nothing any more.
NEGLIGIBLE_STEP = 1e-9
# Worse known than this [m] a new landmark is of no use, and its linearisation no good.
LARGEST_STD = 200.0
# Inverse variance of x and y beforehand [1/m^2]: none, but what is not observed stays solvable.
FLAT_WEIGHT = 1e-12
LOG_2PI = math.log(2.0 * math.pi)


@jit
def propose(density: Density, observed: Observed, speed: float, constants: Constants) -> Births:
    """Fits a landmark of each type to each path, the vehicle being uncertain.

    Starts where the ray of arrival (or of departure) meets the ellipsoid of the delay, then
    Gauss-Newton on all measured components. The vehicle's uncertainty counts as measurement noise,
    R + A P A', and comes back as the correlation with the vehicle. rho is the Laplace approximation
    of the integral of lambda p_D N(z; h(x, s), R) over x and s.

    Args:
        density: predicted.
        observed: J paths.
        speed: v at the snapshot [m/s].
        constants: intensities and the height prior.
    """
    vehicle = density.start[0]
    ue, ue_covariance = density.mean[:vehicle].copy(), density.covariance[:vehicle, :vehicle].copy()
    paths = len(observed.values)
    start, located = np.empty((paths, 3)), np.empty(paths, np.bool_)
    incidence_points(
        ue,
        constants.ue_height,
        constants.bs,
        constants.landmark_height_mean,
        observed.values,
        start,
        located,
    )
    births = Births(
        np.empty((2, paths, 3)),
        np.zeros((2, paths, 3, 3)),
        np.zeros((2, paths, 3, vehicle)),
        np.full((2, paths), -math.inf),
    )
    h, a, b = np.empty(DIM), np.empty((DIM, vehicle)), np.empty((DIM, 3))
    root, white, normal = np.empty((DIM, DIM)), np.empty((DIM, 4)), np.empty((4, 4))
    for t in range(2):
        kind = VA if t == 0 else SP
        for j in range(paths):
            place, used = births.position[t, j], observed.used[j]
            for i in range(3):
                place[i] = start[j, i]
            if not located[j]:
                continue
            if kind == VA:
                to_virtual_anchor(ue, constants.ue_height, constants.bs, place)
            if not fit(
                ue,
                ue_covariance,
                speed,
                constants.bs,
                constants.ue_height,
                constants.landmark_height_mean,
                constants.landmark_height_std,
                observed.values[j],
                used,
                observed.noise[j],
                kind,
                place,
                h,
                a,
                b,
                root,
                white,
                normal,
            ):
                continue
            covariance = births.covariance[t, j]
            if not spread_out(a, root, white, normal, covariance, births.gain[t, j]):
                continue
            blur = distance_std(ue, constants.ue_height, place, covariance)
            births.log_intensity[t, j] = laplace(root, normal, used) + log_undetected(
                density, place, kind, blur, constants
            )
    return births


@jit
def log_undetected(
    density: Density, position: FloatArray, kind: int, blur: float, constants: Constants
) -> float:
    """ln (lambda p_D) at a place (3,) [m], of a type, with a std of the distance [m]."""
    distance = distance_between(density.mean[0], density.mean[1], constants.ue_height, position)
    seen = detection_probability(
        kind, distance, blur, constants.detection_probability, constants.sp_field_of_view
    )
    if not seen > 0.0:
        return -math.inf
    share = log_share_left(
        density.undetected,
        constants.ue_height,
        position,
        kind,
        blur,
        constants.detection_probability,
        constants.sp_field_of_view,
        constants.undetected_floor,
    )
    return constants.log_undetected_intensity + share + math.log(seen)


@jit
def fit(
    ue: FloatArray,
    ue_covariance: FloatArray,
    speed: float,
    bs: FloatArray,
    ue_height: float,
    height_mean: float,
    height_std: float,
    z: FloatArray,
    used: BoolArray,
    noise: FloatArray,
    kind: int,
    position: FloatArray,
    h: FloatArray,
    a: FloatArray,
    b: FloatArray,
    root: FloatArray,
    white: FloatArray,
    normal: FloatArray,
) -> bool:
    """Gauss-Newton from position (3,), which is moved to the best fit.

    Stops when the step is negligible, the linearisation being as good as the one behind it.

    Args:
        ue: as in ``propose``, like all that is not named here.
        z: (6,) the path.
        used: (6,) which of its components count.
        noise: (6, 6) its covariance R.
        kind: type of the landmark.
        position: (3,) [m].
        h: (6,), a (6, 4), b (6, 3), root (6, 6), white (6, 4), normal (4, 4): see ``linearise``.

    Returns:
        Whether there may be such a landmark; if so, the arrays are those at its position.
    """
    for step in range(GAUSS_NEWTON_STEPS + 1):
        facing = observe_source(ue, speed, bs, ue_height, position, kind, h, a, b)[1]
        if not linearise(ue_covariance, z, used, noise, h, a, b, root, white, normal):
            return False
        add_prior(height_mean, height_std, position[2], normal)
        if not cholesky(normal, len(position)):
            return False
        if step == GAUSS_NEWTON_STEPS:
            break
        # The last row of the bordered equations is their right-hand side, and then the step.
        size = solve_bordered(normal, len(position))
        dx, dy, dz = normal[3, 0], normal[3, 1], normal[3, 2]
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        # One cautious step must not leave the region where the linearisation means something.
        share = 1.0 if length <= LARGEST_STD else LARGEST_STD / length
        for i in range(3):
            position[i] += share * normal[3, i]
        if size < NEGLIGIBLE_STEP * NEGLIGIBLE_STEP:  # in standard deviations, squared
            break
    return facing


@jit
def linearise(
    ue_covariance: FloatArray,
    z: FloatArray,
    used: BoolArray,
    noise: FloatArray,
    h: FloatArray,
    a: FloatArray,
    b: FloatArray,
    root: FloatArray,
    white: FloatArray,
    normal: FloatArray,
) -> bool:
    """Normal equations of a landmark's position, with S = R + A P A' = L L'.

    Args:
        ue_covariance: (4, 4) P.
        z: (6,) the path.
        used: (6,) which of its components count.
        noise: (6, 6) R.
        h: (6,) expected measurement.
        a: (6, 4) A = dh/ds; set to zero where not used.
        b: (6, 3) B = dh/dx; set to zero where not used.
        root: (6, 6) to be written: L in the lower triangle.
        white: (6, 4) to be written: L^-1 [B, z - h].
        normal: (4, 4) to be written: white' white in the lower triangle.

    Returns:
        Whether S is positive definite.
    """
    for i in range(DIM):
        white[i, 3] = z[i] - h[i] if used[i] else 0.0
        if not used[i]:
            for k in range(a.shape[1]):
                a[i, k] = 0.0
            b[i, 0] = b[i, 1] = b[i, 2] = 0.0
        white[i, 0], white[i, 1], white[i, 2] = b[i, 0], b[i, 1], b[i, 2]
    white[1, 3] = wrapped(white[1, 3])
    white[3, 3] = wrapped(white[3, 3])
    for i in range(DIM):
        for j in range(i + 1):
            root[i, j] = noise[i, j]
        for k in range(a.shape[1]):
            projected = 0.0
            for m in range(a.shape[1]):
                projected += a[i, m] * ue_covariance[m, k]
            for j in range(i + 1):
                root[i, j] += projected * a[j, k]
    if not cholesky(root, len(root)):
        return False
    forward_columns(root, white, len(root))
    for i in range(4):
        for j in range(i + 1):
            entry = 0.0
            for k in range(DIM):
                entry += white[k, i] * white[k, j]
            normal[i, j] = entry
    return True


@jit
def add_prior(height_mean: float, height_std: float, height: float, normal: FloatArray) -> None:
    """Adds the prior of a position at some height [m] to its normal equations (4, 4)."""
    weight, off = 1.0 / (height_std * height_std), height_mean - height
    normal[0, 0] += FLAT_WEIGHT
    normal[1, 1] += FLAT_WEIGHT
    normal[2, 2] += weight
    normal[3, 2] += weight * off
    normal[3, 3] += weight * off * off


@jit
def spread_out(
    a: FloatArray,
    root: FloatArray,
    white: FloatArray,
    normal: FloatArray,
    covariance: FloatArray,
    gain: FloatArray,
) -> bool:
    """Covariance of the position and its gain from the vehicle.

    cov = (B' S^-1 B + prior)^-1, gain = -cov B' S^-1 A.

    Args:
        a: (6, 4) A; used up.
        root: (6, 6) L.
        white: (6, 4) L^-1 [B, z - h].
        normal: (4, 4) the Cholesky factor of the information in its first three rows.
        covariance: (3, 3) to be written [m^2].
        gain: (3, 4) to be written.

    Returns:
        Whether the position is known well enough to be of use.
    """
    for i in range(3):
        column = covariance[i]
        for j in range(3):
            column[j] = 1.0 if i == j else 0.0
        forward(normal, column, len(column))
        backward(normal, column, len(column))
    for i in range(3):
        for j in range(i):
            mean = 0.5 * (covariance[i, j] + covariance[j, i])
            covariance[i, j] = mean
            covariance[j, i] = mean
    forward_columns(root, a, len(root))
    for i in range(3):
        for k in range(a.shape[1]):
            gain[i, k] = 0.0
        for n in range(DIM):
            weight = 0.0
            for j in range(3):
                weight += covariance[i, j] * white[n, j]
            for k in range(a.shape[1]):
                gain[i, k] -= weight * a[n, k]
    variance: float = covariance[0, 0] + covariance[1, 1] + covariance[2, 2]
    return variance < LARGEST_STD * LARGEST_STD


@jit
def laplace(root: FloatArray, normal: FloatArray, used: BoolArray) -> float:
    """ln of the integral of the likelihood and the prior over the position.

    Args:
        root: (6, 6) Cholesky factor of S.
        normal: (4, 4) that of the information in its first three rows, and in its last corner the
            squared distance of path and prior from the best fit.
        used: (6,) components of the path that count.
    """
    dimension = 0
    for i in range(DIM):
        if used[i]:
            dimension += 1
    unknowns = len(normal) - 1
    volume = (unknowns - dimension) * LOG_2PI
    volume -= log_determinant(normal, unknowns) + log_determinant(root, len(root))
    mismatch: float = normal[3, 3]
    return 0.5 * (volume - mismatch)


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
        gain: (2, J, 3, 4) how the position follows the vehicle: its covariance with any part y of
            the state is ``gain @ cov(s, y)``.
        log_intensity: (2, J) ln rho, the measurement intensity of undetected landmarks; -inf where
            the path cannot have come from such a landmark.
    """

    position: FloatArray
    covariance: FloatArray
    gain: FloatArray
    log_intensity: FloatArray
