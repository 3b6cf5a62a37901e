"""How well every path fits every source."""

from __future__ import annotations

import math

import numpy as np

from dopslam_ros.core.arrays import BoolArray, FloatArray
from dopslam_ros.core.channel import AZIMUTHS, DIM
from dopslam_ros.core.kernels.compiled import compiled
from dopslam_ros.core.kernels.small import cholesky, forward, log_determinant

LOG_2PI = math.log(2.0 * math.pi)
ARRIVAL, DEPARTURE = AZIMUTHS


@compiled
def prepare(
    values: FloatArray,
    covariances: FloatArray,
    used_components: BoolArray,
    default_noise: FloatArray,
    kept: FloatArray,
    used: BoolArray,
    noise: FloatArray,
) -> None:
    """Masks what is not used and fills in the noise of paths that have none of their own.

    Args:
        values: (J, 6), NaN where not measured.
        covariances: (J, 6, 6), zero where the default is meant.
        used_components: (6,).
        default_noise: (6, 6).
        kept: (J, 6) result: values, NaN where they do not count.
        used: (J, 6) result: which count.
        noise: (J, 6, 6) result: symmetric, unit where it does not count.
    """
    for j in range(values.shape[0]):
        given = False
        for k in range(DIM):
            used[j, k] = used_components[k] and math.isfinite(values[j, k])
            kept[j, k] = values[j, k] if used[j, k] else math.nan
            for i in range(DIM):
                given = given or covariances[j, k, i] != 0.0
        source = covariances[j] if given else default_noise
        for k in range(DIM):
            for i in range(DIM):
                if used[j, k] and used[j, i]:
                    noise[j, k, i] = 0.5 * (source[k, i] + source[i, k])
                else:
                    noise[j, k, i] = 1.0 if i == k else 0.0


@compiled
def project(
    a: FloatArray,
    b: FloatArray,
    covariance: FloatArray,
    projected: FloatArray,
) -> None:
    """Covariance of h from what is uncertain in the state: A P A' + B P B' + cross terms.

    Args:
        a: (M, d, 4) Jacobians by the vehicle.
        b: (M, d, 3) by the placement of source m, which is block m - 1; that of source 0, the BS,
            does not count.
        covariance: (4 + 3 (M - 1), 4 + 3 (M - 1)).
        projected: (M, d, d) result.
    """
    count, dim = a.shape[0], a.shape[1]
    rows = np.empty((dim, 7))
    for m in range(count):
        column = 1 + 3 * m
        for k in range(dim):
            for j in range(7):
                at = j if j < 4 else column + j - 4
                total = 0.0
                if j < 4 or m > 0:
                    for i in range(4):
                        total += a[m, k, i] * covariance[i, at]
                    if m > 0:
                        for i in range(3):
                            total += b[m, k, i] * covariance[column + i, at]
                rows[k, j] = total
        for k in range(dim):
            for l in range(k + 1):  # noqa: E741
                total = 0.0
                for j in range(4):
                    total += rows[k, j] * a[m, l, j]
                if m > 0:
                    for j in range(3):
                        total += rows[k, 4 + j] * b[m, l, j]
                projected[m, k, l] = total
                projected[m, l, k] = total


@compiled
def log_likelihoods(
    projected: FloatArray,
    expected: FloatArray,
    degenerate: BoolArray,
    values: FloatArray,
    used: BoolArray,
    noise: FloatArray,
    gates: FloatArray,
    innovation: FloatArray,
    log_likelihood: FloatArray,
) -> bool:
    """ln N(z_j; h_m, S_m + R_j) of all pairs over the components that count.

    Args:
        projected: (M, 6, 6) covariance of h.
        expected: (M, 6) h.
        degenerate: (M,) sources of which nothing can be said.
        values: (J, 6) z.
        used: (J, 6) components that count.
        noise: (J, 6, 6) R.
        gates: (7,) largest squared distance by the number of components.
        innovation: (M, J, 6) result: z - h, azimuths wrapped, zero where it does not count.
        log_likelihood: (M, J) result, -inf outside the gate.

    Returns:
        Whether all covariances were positive definite.
    """
    s = np.empty((DIM, DIM))
    v = np.empty(DIM)
    place = np.empty(DIM, np.int64)
    for j in range(values.shape[0]):
        count = 0
        for c in range(DIM):
            if used[j, c]:
                place[count] = c
                count += 1
        gate = gates[count]
        for m in range(expected.shape[0]):
            log_likelihood[m, j] = -np.inf
            outside = degenerate[m]
            for c in range(DIM):
                difference = 0.0
                if used[j, c]:
                    difference = values[j, c] - expected[m, c]
                    if c in (ARRIVAL, DEPARTURE):
                        difference = math.pi - (math.pi - difference) % (2.0 * math.pi)
                    # The distance in one component is never larger than that in all.
                    variance = projected[m, c, c] + noise[j, c, c]
                    if difference * difference > gate * variance:
                        outside = True
                innovation[m, j, c] = difference
            if outside:
                continue
            for k in range(count):
                v[k] = innovation[m, j, place[k]]
                for i in range(k + 1):
                    s[k, i] = projected[m, place[k], place[i]] + noise[j, place[k], place[i]]
            if not cholesky(s, count):
                return False
            forward(s, v, count)
            distance = 0.0
            for k in range(count):
                distance += v[k] * v[k]
            if distance <= gate:
                constant = count * LOG_2PI + log_determinant(s, count)
                log_likelihood[m, j] = -0.5 * (distance + constant)
    return True
