"""A landmark fitted to a single path: Gauss-Newton and the Laplace approximation.

Sizes are passed on as ``len(...)``: for literals the callees would be compiled once more each.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dopslam_ros.core.linalg.arrays import BoolArray, FloatArray
from dopslam_ros.core.linalg.jit import jit, jit_inline
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
from dopslam_ros.core.settings.layout import (
    AOA_AZIMUTH,
    AOD_AZIMUTH,
    DIM,
    SPACE,
    UNKNOWN_TYPES,
    VA,
    X,
    Y,
)

GAUSS_NEWTON_STEPS = 6
# A step of less than this many standard deviations changes nothing any more.
NEGLIGIBLE_STEP = 1e-9
# Worse known than this [m] a new landmark is of no use, and its linearisation no good.
LARGEST_STD = 200.0
# Inverse variance of x and y beforehand [1/m^2]: none, but what is not observed stays solvable.
FLAT_WEIGHT = 1e-12
LOG_2PI = math.log(2.0 * math.pi)


class Vehicle(NamedTuple):
    """What is known of the vehicle where births are fitted.

    Attributes:
        mean: (U,) s.
        covariance: (U, U) P.
        speed: v [m/s].
    """

    mean: FloatArray
    covariance: FloatArray
    speed: float


class Workspace(NamedTuple):
    """Of a fit, written again by every step of it.

    Attributes:
        h: (6,) expected measurement.
        a: (6, U) A = dh/ds, zero where not used.
        b: (6, 3) B = dh/dx, zero where not used.
        root: (6, 6) L of S = R + A P A' = L L', in the lower triangle.
        white: (6, 4) L^-1 [B, z - h].
        normal: (4, 4) white' white and the prior in the lower triangle, then its Cholesky factor.
    """

    h: FloatArray
    a: FloatArray
    b: FloatArray
    root: FloatArray
    white: FloatArray
    normal: FloatArray


@jit_inline
def workspace(size: int) -> Workspace:
    """For a vehicle with so many components."""
    return Workspace(
        np.empty(DIM),
        np.empty((DIM, size)),
        np.empty((DIM, SPACE)),
        np.empty((DIM, DIM)),
        np.empty((DIM, SPACE + 1)),
        np.empty((SPACE + 1, SPACE + 1)),
    )


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
    size, paths = density.start[0], len(observed.values)
    ue, covariance = density.mean[:size].copy(), density.covariance[:size, :size].copy()
    vehicle, work = Vehicle(ue, covariance, speed), workspace(size)
    start, located = np.empty((paths, SPACE)), np.empty(paths, np.bool_)
    incidence_points(
        ue,
        constants.ue_height,
        constants.bs,
        constants.landmark_height_mean,
        observed.values,
        start,
        located,
    )
    types = len(UNKNOWN_TYPES)
    births = Births(
        np.empty((types, paths, SPACE)),
        np.zeros((types, paths, SPACE, SPACE)),
        np.zeros((types, paths, SPACE, size)),
        np.full((types, paths), -math.inf),
    )
    for t in range(types):
        kind = UNKNOWN_TYPES[t]
        for j in range(paths):
            position = births.position[t, j]
            for i in range(SPACE):
                position[i] = start[j, i]
            if not located[j]:
                continue
            if kind == VA:
                to_virtual_anchor(ue, constants.ue_height, constants.bs, position)
            if fit(vehicle, observed, j, kind, constants, position, work):
                births.log_intensity[t, j] = conclude_birth(
                    density, observed, t, j, constants, births, work
                )
    return births


@jit_inline
def conclude_birth(
    density: Density,
    observed: Observed,
    t: int,
    j: int,
    constants: Constants,
    births: Births,
    work: Workspace,
) -> float:
    """Covariance and gain of what was fitted to path j as type t; ln rho, -inf if of no use."""
    position, covariance = births.position[t, j], births.covariance[t, j]
    if not posterior_of_fit(work, covariance, births.gain[t, j]):
        return -math.inf
    std = distance_std(density.mean, constants.ue_height, position, covariance)
    undetected = log_undetected(density, position, UNKNOWN_TYPES[t], std, constants)
    return laplace(work.root, work.normal, observed.used[j]) + undetected


@jit_inline
def log_undetected(
    density: Density, position: FloatArray, kind: int, std: float, constants: Constants
) -> float:
    """ln (lambda p_D) at a position (3,) [m], of a type, with a std of the distance [m]."""
    distance = distance_between(density.mean[X], density.mean[Y], constants.ue_height, position)
    detection = detection_probability(
        kind, distance, std, constants.detection_probability, constants.sp_field_of_view
    )
    if not detection > 0.0:
        return -math.inf
    share = log_share_left(
        density.undetected,
        constants.ue_height,
        position,
        kind,
        std,
        constants.detection_probability,
        constants.sp_field_of_view,
        constants.undetected_floor,
    )
    return constants.log_undetected_intensity + share + math.log(detection)


@jit_inline
def fit(
    vehicle: Vehicle,
    observed: Observed,
    j: int,
    kind: int,
    constants: Constants,
    position: FloatArray,
    work: Workspace,
) -> bool:
    """Gauss-Newton from position (3,), which is moved to the best fit to path j.

    Stops when the step is negligible, the linearisation being as good as the one behind it.

    Args:
        vehicle: which is uncertain.
        observed: the paths.
        j: the path.
        kind: type of the landmark.
        constants: BS and the height prior.
        position: (3,) [m].
        work: that of the last linearisation afterwards.

    Returns:
        Whether there may be such a landmark; if so, the workspace is that at its position.
    """
    bs, ue_height, normal = constants.bs, constants.ue_height, work.normal
    for step in range(GAUSS_NEWTON_STEPS + 1):
        facing = observe_source(
            vehicle.mean, vehicle.speed, bs, ue_height, position, kind, work.h, work.a, work.b
        )[1]
        if not linearise(vehicle.covariance, observed, j, work):
            return False
        add_height_prior(constants, position[2], normal)
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
        for i in range(SPACE):
            position[i] += share * normal[3, i]
        if size < NEGLIGIBLE_STEP * NEGLIGIBLE_STEP:  # in standard deviations, squared
            break
    return facing


@jit_inline
def linearise(ue_covariance: FloatArray, observed: Observed, j: int, work: Workspace) -> bool:
    """Normal equations of a landmark's position, with S = R + A P A' = L L'.

    Args:
        ue_covariance: (U, U) P.
        observed: the paths.
        j: the path.
        work: h, A and B are given; A and B are set to zero where not used, the rest is written.

    Returns:
        Whether S is positive definite.
    """
    used, values, h, a, b = observed.used, observed.values, work.h, work.a, work.b
    white, normal = work.white, work.normal
    for i in range(DIM):
        white[i, SPACE] = values[j, i] - h[i] if used[j, i] else 0.0
        if not used[j, i]:
            for k in range(a.shape[1]):
                a[i, k] = 0.0
            b[i, 0] = b[i, 1] = b[i, 2] = 0.0
        white[i, 0], white[i, 1], white[i, 2] = b[i, 0], b[i, 1], b[i, 2]
    white[AOA_AZIMUTH, SPACE] = wrapped(white[AOA_AZIMUTH, SPACE])
    white[AOD_AZIMUTH, SPACE] = wrapped(white[AOD_AZIMUTH, SPACE])
    add_congruence(a, ue_covariance, observed.noise, j, work.root)
    if not cholesky(work.root, len(work.root)):
        return False
    forward_columns(work.root, white, len(work.root))
    for i in range(len(normal)):
        for k in range(i + 1):
            entry = 0.0
            for c in range(DIM):
                entry += white[c, i] * white[c, k]
            normal[i, k] = entry
    return True


@jit_inline
def add_congruence(
    a: FloatArray, covariance: FloatArray, noise: FloatArray, j: int, s: FloatArray
) -> None:
    """S = R + A P A', the lower triangle of (6, 6): R noise[j], A (6, U), P (U, U)."""
    for i in range(len(s)):
        for k in range(i + 1):
            s[i, k] = noise[j, i, k]
        for m in range(a.shape[1]):
            projected = 0.0
            for n in range(a.shape[1]):
                projected += a[i, n] * covariance[n, m]
            for k in range(i + 1):
                s[i, k] += projected * a[k, m]


@jit_inline
def add_height_prior(constants: Constants, height: float, normal: FloatArray) -> None:
    """Adds the prior of a position at some height [m] to its normal equations (4, 4)."""
    std = constants.landmark_height_std
    weight, off = 1.0 / (std * std), constants.landmark_height_mean - height
    normal[0, 0] += FLAT_WEIGHT
    normal[1, 1] += FLAT_WEIGHT
    normal[2, 2] += weight
    normal[3, 2] += weight * off
    normal[3, 3] += weight * off * off


@jit_inline
def posterior_of_fit(work: Workspace, covariance: FloatArray, gain: FloatArray) -> bool:
    """Covariance of the position and its gain from the vehicle.

    cov = (B' S^-1 B + prior)^-1, gain = -cov B' S^-1 A.

    Args:
        work: of the fit; A is used up.
        covariance: (3, 3) to be written [m^2].
        gain: (3, U) to be written.

    Returns:
        Whether the position is known well enough to be of use.
    """
    a, root, white, normal = work.a, work.root, work.white, work.normal
    for i in range(SPACE):
        column = covariance[i]
        for j in range(SPACE):
            column[j] = 1.0 if i == j else 0.0
        forward(normal, column, len(column))
        backward(normal, column, len(column))
    for i in range(SPACE):
        for j in range(i):
            mean = 0.5 * (covariance[i, j] + covariance[j, i])
            covariance[i, j] = mean
            covariance[j, i] = mean
    forward_columns(root, a, len(root))
    for i in range(SPACE):
        for k in range(a.shape[1]):
            gain[i, k] = 0.0
        for n in range(DIM):
            weight = 0.0
            for j in range(SPACE):
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
