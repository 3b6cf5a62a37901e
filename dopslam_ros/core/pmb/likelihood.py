"""Local likelihoods: how well every path fits every source."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dopslam_ros.core.linalg.arrays import BoolArray, FloatArray
from dopslam_ros.core.linalg.jit import from_python, jit, jit_inline
from dopslam_ros.core.linalg.small import cholesky, forward, log_determinant, used_places
from dopslam_ros.core.linalg.vec import Vec, between, unit, vec
from dopslam_ros.core.models.channel_kernels import observe_source, wrapped
from dopslam_ros.core.models.detection_kernels import detection_probability
from dopslam_ros.core.pmb.coordinates_kernels import place, place_jacobian
from dopslam_ros.core.pmb.density import Density, block_of
from dopslam_ros.core.settings.filtering import Constants
from dopslam_ros.core.settings.layout import (
    AOA_AZIMUTH,
    AOD_AZIMUTH,
    BS,
    BS_ID,
    DIM,
    LARGEST_LANDMARK,
    SPACE,
    X,
    Y,
)

LOG_2PI = math.log(2.0 * math.pi)


class Observed(NamedTuple):
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


class Likelihoods(NamedTuple):
    """Each path against the BS (source 0) and the components (sources 1 ... C).

    Attributes:
        ue_jacobian: (C + 1, 6, U) A = dh/ds, U components of the vehicle.
        landmark_jacobian: (C + 1, 6, L) B = dh/dq, zero for the BS; L of the largest landmark.
        detection: (C + 1,) p_D.
        innovation: (C + 1, J, 6) z - h, zero where not used.
        log_likelihood: (C + 1, J) ln N(z; h, S); -inf outside the gate.
    """

    ue_jacobian: FloatArray
    landmark_jacobian: FloatArray
    detection: FloatArray
    innovation: FloatArray
    log_likelihood: FloatArray


class Expected(NamedTuple):
    """What would be heard of each source, and how sure that is.

    Attributes:
        h: (C + 1, 6).
        covariance: (C + 1, 6, 6) of h, from what is uncertain in the state.
        degenerate: (C + 1,) nothing can be said.
    """

    h: FloatArray
    covariance: FloatArray
    degenerate: BoolArray


@from_python
def prepare(
    values: FloatArray,
    covariances: FloatArray,
    used_components: BoolArray,
    default_noise: FloatArray,
) -> Observed:
    """Masks what is not used and fills in the noise of paths that have none of their own.

    Args:
        values: (J, 6), NaN where not measured.
        covariances: (J, 6, 6), zero where the default is meant.
        used_components: (6,).
        default_noise: (6, 6).
    """
    kept, used = np.empty(values.shape), np.empty(values.shape, np.bool_)
    noise = np.empty(covariances.shape)
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
    return Observed(kept, used, noise)


@jit_inline
def local_likelihoods(
    density: Density, observed: Observed, speed: float, constants: Constants
) -> tuple[Likelihoods, bool]:
    """N(z_j; h_i, S_i) with S = A P A' + B P B' + cross terms + R.

    Args:
        density: predicted.
        observed: J paths.
        speed: v at the snapshot [m/s].
        constants: gate, p_D and noise.

    Returns:
        The likelihoods, and whether all covariances were positive definite.
    """
    sources, paths = len(density.start), len(observed.values)
    likelihoods = Likelihoods(
        np.empty((sources, DIM, density.start[0])),
        np.empty((sources, DIM, LARGEST_LANDMARK)),
        np.empty(sources),
        np.empty((sources, paths, DIM)),
        np.empty((sources, paths)),
    )
    expected = Expected(
        np.empty((sources, DIM)), np.empty((sources, DIM, DIM)), np.empty(sources, np.bool_)
    )
    expect_sources(density, speed, constants, likelihoods, expected)
    definite = weigh_pairs(expected, observed, constants.gates, likelihoods)
    return likelihoods, definite


@jit_inline
def expect_sources(
    density: Density,
    speed: float,
    constants: Constants,
    likelihoods: Likelihoods,
    expected: Expected,
) -> None:
    """h, A, B and p_D of the BS (source 0) and of the components; the results are written.

    Args:
        density: predicted.
        speed: v [m/s].
        constants: where the BS is, what is visible.
        likelihoods: result: Jacobians and p_D.
        expected: result.
    """
    mean, vehicle, bs = density.mean, density.start[0], constants.bs
    a, b, detection = (
        likelihoods.ue_jacobian,
        likelihoods.landmark_jacobian,
        likelihoods.detection,
    )
    position = bs.copy()
    to_position, by_position = np.zeros((SPACE, b.shape[2])), np.empty((DIM, SPACE))
    by_vehicle, by_landmark = np.zeros((1, 1, vehicle)), np.zeros((1, 1, b.shape[2]))
    variance = np.empty((1, 1))
    for m in range(len(density.start)):
        kind = BS
        if m > 0:
            kind = density.component_type[m - 1]
            q = mean[density.start[m - 1] : density.start[m]]
            place(density.origin[m - 1], density.axes[m - 1], q, position)
            place_jacobian(density.axes[m - 1], q, to_position)
        expected.degenerate[m], _ = observe_source(
            mean[:vehicle],
            speed,
            bs,
            constants.ue_height,
            position,
            kind,
            expected.h[m],
            a[m],
            by_position,
        )
        for k in range(DIM):
            for j in range(b.shape[2]):
                b[m, k, j] = 0.0
                for i in range(SPACE):
                    b[m, k, j] += by_position[k, i] * to_position[i, j]
        covariance_of(a[m], b[m], m, density, expected.covariance[m])
        if expected.degenerate[m]:
            detection[m] = 0.0
            continue
        distance, u = unit(between(Vec(mean[X], mean[Y], constants.ue_height), vec(position)))
        by_vehicle[0, 0, X], by_vehicle[0, 0, Y] = -u.x, -u.y
        for j in range(b.shape[2]):
            by_landmark[0, 0, j] = (
                u.x * to_position[0, j] + u.y * to_position[1, j] + u.z * to_position[2, j]
            )
        covariance_of(by_vehicle[0], by_landmark[0], m, density, variance)
        std = math.sqrt(max(variance[0, 0], 0.0))
        detection[m] = detection_probability(
            kind, distance, std, constants.detection_probability, constants.sp_field_of_view
        )


@jit
def covariance_of(
    a: FloatArray, b: FloatArray, source: int, density: Density, result: FloatArray
) -> None:
    """A P A' + B P B' + cross terms: the covariance of what depends on vehicle and a source.

    Args:
        a: (d, U) Jacobian by the vehicle.
        b: (d, L) by the source's own block; not used for source 0.
        source: 0 the BS, m component m - 1.
        density: of which P is the covariance.
        result: (d, d).
    """
    covariance, vehicle = density.covariance, len(density.vehicle)
    first, size = block_of(density.start, source)
    row = np.empty(vehicle + b.shape[1])
    for k in range(a.shape[0]):
        for j in range(vehicle if source == BS_ID else vehicle + size):
            at = j if j < vehicle else first + j - vehicle
            total = 0.0
            for i in range(vehicle):
                total += a[k, i] * covariance[i, at]
            if source != BS_ID:
                for i in range(size):
                    total += b[k, i] * covariance[first + i, at]
            row[j] = total
        for other in range(k + 1):
            total = 0.0
            for j in range(vehicle):
                total += row[j] * a[other, j]
            if source != BS_ID:
                for j in range(size):
                    total += row[vehicle + j] * b[other, j]
            result[k, other] = total
            result[other, k] = total


@jit
def weigh_pairs(
    expected: Expected, observed: Observed, gates: FloatArray, likelihoods: Likelihoods
) -> bool:
    """ln N(z_j; h_m, S_m + R_j) of all pairs over the components that count.

    Args:
        expected: of M sources.
        observed: J paths.
        gates: (7,) largest squared distance by the number of components.
        likelihoods: result: innovations, azimuths wrapped, and log-likelihoods.

    Returns:
        Whether all covariances were positive definite.
    """
    used, noise, degenerate = observed.used, observed.noise, expected.degenerate
    covariance, innovation = expected.covariance, likelihoods.innovation
    log_likelihood = likelihoods.log_likelihood
    definite = True
    s, v, component = np.empty((DIM, DIM)), np.empty(DIM), np.empty(DIM, np.int64)
    for j in range(len(used)):
        count = used_places(used[j], component)
        gate = gates[count]
        for m in range(len(degenerate)):
            log_likelihood[m, j] = -np.inf
            inside = innovate(expected, observed, m, j, gate, innovation)
            if not inside or degenerate[m]:
                continue
            for k in range(count):
                c = component[k]
                v[k] = innovation[m, j, c]
                for i in range(k + 1):
                    s[k, i] = covariance[m, c, component[i]] + noise[j, c, component[i]]
            if not cholesky(s, count):
                definite = False
                continue
            forward(s, v, count)
            distance = 0.0
            for k in range(count):
                distance += v[k] * v[k]
            if distance <= gate:
                constant = count * LOG_2PI + log_determinant(s, count)
                log_likelihood[m, j] = -0.5 * (distance + constant)
    return definite


@jit_inline
def innovate(
    expected: Expected, observed: Observed, m: int, j: int, gate: float, innovation: FloatArray
) -> bool:
    """z - h of a pair into innovation[m, j]; whether each component alone is inside the gate.

    Where h is right the innovation is the noise of eq. (3). The distance in one component is never
    larger than that in all.
    """
    used, values, noise = observed.used, observed.values, observed.noise
    h, covariance = expected.h, expected.covariance
    inside = True
    for c in range(DIM):
        difference = 0.0
        if used[j, c]:
            difference = values[j, c] - h[m, c]
            if c in (AOA_AZIMUTH, AOD_AZIMUTH):
                difference = wrapped(difference)
            variance = covariance[m, c, c] + noise[j, c, c]
            if difference * difference > gate * variance:
                inside = False
        innovation[m, j, c] = difference
    return inside
