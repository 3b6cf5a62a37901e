"""The normal equations of a landmark's position given one path: building blocks of ``birth``."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dopslam_ros.core.linalg.arrays import BoolArray, FloatArray
from dopslam_ros.core.linalg.jit import jit_inline
from dopslam_ros.core.linalg.small import cholesky, forward_columns, invert, log_determinant
from dopslam_ros.core.models.channel_kernels import wrapped
from dopslam_ros.core.pmb.likelihood import Observed
from dopslam_ros.core.settings.layout import AZIMUTHS, DIM, SPACE, Components

# Worse known than this [m] a new landmark is of no use, and its linearisation no good.
LARGEST_STD = 200.0
# Inverse variance of x and y beforehand [1/m^2]: none, but what is not observed stays solvable.
FLAT_WEIGHT = 1e-12
LOG_2PI = math.log(2.0 * math.pi)


class Fit(NamedTuple):
    """The linear equations of a position x, to work with; S numbers make up the vehicle.

    Attributes:
        h: (6,) expected path.
        a: (6, S) A = dh/ds.
        b: (6, 3) B = dh/dx.
        root: (6, 6) L in the lower triangle, L L' = S = R + A P A'.
        white: (6, 4) L^-1 [B, z - h].
        normal: (4, 4) in the lower triangle white' white, the prior added; at the best fit the
            Cholesky factor of the information in the first three rows, and in the last corner the
            squared distance of path and prior from it.
        vehicle: its components, of which the compiler knows how many there are.
    """

    h: FloatArray
    a: FloatArray
    b: FloatArray
    root: FloatArray
    white: FloatArray
    normal: FloatArray
    vehicle: Components


@jit_inline
def new_fit(vehicle: Components) -> Fit:
    """Room for the equations."""
    return Fit(
        np.empty(DIM),
        np.empty((DIM, len(vehicle))),
        np.empty((DIM, SPACE)),
        np.empty((DIM, DIM)),
        np.empty((DIM, SPACE + 1)),
        np.empty((SPACE + 1, SPACE + 1)),
        vehicle,
    )


@jit_inline
def linearise(ue_covariance: FloatArray, observed: Observed, j: int, fit: Fit) -> bool:
    """Normal equations of a landmark's position given path j, with S = R + A P A' = L L'.

    Args:
        ue_covariance: (n, n), the vehicle's P (S, S) first.
        observed: the paths.
        j: the one that is fitted.
        fit: h, A and B are read, the rows of A and B that are not used set to zero; the rest is
            written: ``normal`` without the prior.

    Returns:
        Whether S is positive definite.
    """
    a, b, root, white = fit.a, fit.b, fit.root, fit.white
    for i in range(DIM):
        used = observed.used[j, i]
        white[i, SPACE] = observed.values[j, i] - fit.h[i] if used else 0.0
        if not used:
            for m in range(len(fit.vehicle)):
                a[i, m] = 0.0
            for m in range(SPACE):
                b[i, m] = 0.0
        for m in range(SPACE):
            white[i, m] = b[i, m]
    for i in AZIMUTHS:
        white[i, SPACE] = wrapped(white[i, SPACE])
    for i in range(DIM):
        for k in range(i + 1):
            root[i, k] = observed.noise[j, i, k]
        for m in range(len(fit.vehicle)):
            projected = 0.0
            for p in range(len(fit.vehicle)):
                projected += a[i, p] * ue_covariance[p, m]
            for k in range(i + 1):
                root[i, k] += projected * a[k, m]
    if not cholesky(root, len(root)):
        return False
    forward_columns(root, white, len(root))
    for i in range(SPACE + 1):
        for k in range(i + 1):
            total = 0.0
            for m in range(DIM):
                total += white[m, i] * white[m, k]
            fit.normal[i, k] = total
    return True


@jit_inline
def add_prior(height_mean: float, height_std: float, height: float, normal: FloatArray) -> None:
    """Adds the prior of a position at some height [m] to its normal equations (4, 4)."""
    weight, below = 1.0 / (height_std * height_std), height_mean - height
    normal[0, 0] += FLAT_WEIGHT
    normal[1, 1] += FLAT_WEIGHT
    normal[2, 2] += weight
    normal[SPACE, 2] += weight * below
    normal[SPACE, SPACE] += weight * below * below


@jit_inline
def position_posterior(fit: Fit, covariance: FloatArray, gain: FloatArray) -> bool:
    """Covariance of the position, and how it follows the vehicle.

    cov = (B' S^-1 B + prior)^-1, gain = dx/ds = -cov B' S^-1 A.

    Args:
        fit: at the best fit; A is used up.
        covariance: (3, 3) to be written [m^2].
        gain: (3, S) to be written.

    Returns:
        Whether the position is known well enough to be of use.
    """
    invert(fit.normal, len(covariance), covariance)
    for i in range(SPACE):
        for j in range(i):
            mean = 0.5 * (covariance[i, j] + covariance[j, i])
            covariance[i, j] = mean
            covariance[j, i] = mean
    forward_columns(fit.root, fit.a, len(fit.root))
    for i in range(SPACE):
        for k in range(len(fit.vehicle)):
            gain[i, k] = 0.0
        for n in range(DIM):
            weight = 0.0
            for j in range(SPACE):
                weight += covariance[i, j] * fit.white[n, j]
            for k in range(len(fit.vehicle)):
                gain[i, k] -= weight * fit.a[n, k]
    variance: float = covariance[0, 0] + covariance[1, 1] + covariance[2, 2]
    return variance < LARGEST_STD * LARGEST_STD


@jit_inline
def laplace(fit: Fit, used: BoolArray) -> float:
    """ln of the integral of the likelihood and the prior over the position.

    Args:
        fit: at the best fit.
        used: (6,) components of the path that count.
    """
    dimension = 0
    for i in range(DIM):
        if used[i]:
            dimension += 1
    unknowns = len(fit.normal) - 1
    volume = (unknowns - dimension) * LOG_2PI
    volume -= log_determinant(fit.normal, unknowns) + log_determinant(fit.root, len(fit.root))
    distance: float = fit.normal[SPACE, SPACE]
    return 0.5 * (volume - distance)
