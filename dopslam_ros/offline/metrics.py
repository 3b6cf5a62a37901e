"""How good an estimate is: GOSPA, RMSE, NEES and the weight of the correct association."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from dopslam_ros.core.linalg.arrays import FloatArray, wrap_angle
from dopslam_ros.core.settings.layout import ANGLES, CLOCK_BIAS, HEADING, X, Y


class Gospa(NamedTuple):
    """GOSPA distance with alpha = 2 and the three parts it is made of.

    Attributes:
        distance: (localisation + missed + false)^(1/p) [m].
        localisation: sum of d^p over the pairs [m^p].
        missed: c^p / 2 per true landmark without a pair [m^p].
        false: c^p / 2 per estimate without a pair [m^p].
    """

    distance: float
    localisation: float
    missed: float
    false: float


def gospa(truth: FloatArray, estimate: FloatArray, c: float = 20.0, p: float = 2.0) -> Gospa:
    """Generalised optimal sub-pattern assignment, Rahmathullah et al. 2017, alpha = 2.

    Pairs at or beyond the cut-off are never made: they cost as much as leaving both alone.

    Args:
        truth: (n, 3) [m].
        estimate: (m, 3) [m].
        c: cut-off [m].
        p: order.
    """
    half = c**p / 2.0
    distance = np.linalg.norm(truth[:, None, :] - estimate[None, :, :], axis=2)
    cost = np.minimum(distance, c) ** p
    rows, columns = linear_sum_assignment(cost)
    paired = distance[rows, columns] < c
    pairs = int(paired.sum())
    localisation = float(cost[rows, columns][paired].sum())
    missed = half * (len(truth) - pairs)
    false = half * (len(estimate) - pairs)
    return Gospa((localisation + missed + false) ** (1.0 / p), localisation, missed, false)


def state_errors(estimate: FloatArray, truth: FloatArray) -> FloatArray:
    """(..., U) estimate of the vehicle minus truth, angles wrapped."""
    error = np.asarray(estimate - truth, dtype=np.float64).copy()
    angles = np.flatnonzero(ANGLES)
    error[..., angles] = wrap_angle(error[..., angles])
    return error


def nees(error: FloatArray, covariance: FloatArray) -> float:
    """Normalised estimation error squared e' P^-1 e of (n,) and (n, n); n where P is honest."""
    return float(error @ np.linalg.solve(covariance, error))


class Rmse(NamedTuple):
    """Root mean square errors over all steps (and runs)."""

    position: float
    heading_deg: float
    clock_bias: float


def rmse(errors: FloatArray) -> Rmse:
    """Of errors (..., U): position [m] (both axes together), heading [deg], clock bias [m]."""
    square = np.mean(np.reshape(errors, (-1, errors.shape[-1])) ** 2, axis=0)
    return Rmse(
        position=math.sqrt(square[X] + square[Y]),
        heading_deg=math.degrees(math.sqrt(square[HEADING])),
        clock_bias=math.sqrt(square[CLOCK_BIAS]),
    )
