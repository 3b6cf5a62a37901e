"""How well every path fits every source."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dopslam_ros.core.linalg.arrays import BoolArray, FloatArray
from dopslam_ros.core.linalg.jit import from_python, jit, jit_inline
from dopslam_ros.core.linalg.small import cholesky, forward, log_determinant, used_places
from dopslam_ros.core.models.channel_kernels import observe_source, unit, wrapped
from dopslam_ros.core.models.detection_kernels import detection_probability
from dopslam_ros.core.pmb.coordinates_kernels import place, place_jacobian
from dopslam_ros.core.pmb.density import Density
from dopslam_ros.core.settings.filtering import Constants
from dopslam_ros.core.settings.layout import AZIMUTHS, BS, DIM, UE

LOG_2PI = math.log(2.0 * math.pi)
ARRIVAL, DEPARTURE = AZIMUTHS


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
def weigh(
    density: Density, observed: Observed, speed: float, constants: Constants
) -> tuple[Likelihoods, bool]:
    """Local likelihoods N(z_j; h_i, S_i) with S = A P A' + B P B' + cross terms + R.

    Args:
        density: predicted.
        observed: J paths.
        speed: v at the snapshot [m/s].
        constants: gate, p_D and noise.

    Returns:
        The evidence, and whether all covariances were positive definite.
    """
    sources, paths = len(density.component_type) + 1, len(observed.values)
    evidence = Likelihoods(
        np.empty((sources, DIM, UE)),
        np.empty((sources, DIM, 3)),
        np.empty(sources),
        np.empty((sources, paths, DIM)),
        np.empty((sources, paths)),
    )
    expected, projected = np.empty((sources, DIM)), np.empty((sources, DIM, DIM))
    degenerate = np.empty(sources, np.bool_)
    look_at_sources(density, speed, constants, evidence, expected, degenerate, projected)
    sound = log_likelihoods(
        projected,
        expected,
        degenerate,
        observed,
        constants.gates,
        evidence.innovation,
        evidence.log_likelihood,
    )
    return evidence, sound


@jit_inline
def look_at_sources(
    density: Density,
    speed: float,
    constants: Constants,
    evidence: Likelihoods,
    expected: FloatArray,
    degenerate: BoolArray,
    projected: FloatArray,
) -> None:
    """What would be heard of the BS (source 0) and of the components, and how sure that is.

    Args:
        density: predicted.
        speed: v [m/s].
        constants: where the BS is, what is visible.
        evidence: result: Jacobians and p_D.
        expected: (C + 1, 6) result: h.
        degenerate: (C + 1,) result: nothing can be said.
        projected: (C + 1, 6, 6) result: covariance of h.
    """
    mean, covariance, bs = density.mean, density.covariance, constants.bs
    a, b, detection = evidence.ue_jacobian, evidence.landmark_jacobian, evidence.detection
    origin, axes, component_type = density.origin, density.axes, density.component_type
    ue_height = constants.ue_height
    position = bs.copy()
    to_position = np.zeros((3, 3))
    by_position = np.empty((DIM, 3))
    by_vehicle, by_placement = np.zeros((1, 1, UE)), np.zeros((1, 1, 3))
    blur = np.empty((1, 1))
    for m in range(len(component_type) + 1):
        kind = BS
        if m > 0:
            kind = component_type[m - 1]
            q = mean[UE + 3 * (m - 1) : UE + 3 * m]
            place(origin[m - 1], axes[m - 1], q, position)
            place_jacobian(axes[m - 1], q, to_position)
        degenerate[m], _ = observe_source(
            mean[:UE], speed, bs, ue_height, position, kind, expected[m], a[m], by_position
        )
        for k in range(DIM):
            for j in range(3):
                b[m, k, j] = 0.0
                for i in range(3):
                    b[m, k, j] += by_position[k, i] * to_position[i, j]
        project_one(a[m], b[m], m, covariance, projected[m])
        if degenerate[m]:
            detection[m] = 0.0
            continue
        distance, ux, uy, uz = unit(
            position[0] - mean[0], position[1] - mean[1], position[2] - ue_height
        )
        by_vehicle[0, 0, 0], by_vehicle[0, 0, 1] = -ux, -uy
        for j in range(3):
            by_placement[0, 0, j] = (
                ux * to_position[0, j] + uy * to_position[1, j] + uz * to_position[2, j]
            )
        project_one(by_vehicle[0], by_placement[0], m, covariance, blur)
        spread = math.sqrt(max(blur[0, 0], 0.0))
        detection[m] = detection_probability(
            kind, distance, spread, constants.detection_probability, constants.sp_field_of_view
        )


@jit
def project_one(
    a: FloatArray, b: FloatArray, source: int, covariance: FloatArray, projected: FloatArray
) -> None:
    """Covariance of h from what is uncertain in the state: A P A' + B P B' + cross terms.

    Args:
        a: (d, 4) Jacobian by the vehicle.
        b: (d, 3) by the placement of the source, which is block source - 1; not used for source 0.
        source: its number.
        covariance: of the joint vector.
        projected: (d, d) result.
    """
    dim = a.shape[0]
    column = UE + 3 * (source - 1)
    width = UE if source == 0 else UE + 3
    row = np.empty(UE + 3)
    for k in range(dim):
        for j in range(width):
            at = j if j < UE else column + j - UE
            total = 0.0
            for i in range(UE):
                total += a[k, i] * covariance[i, at]
            if source > 0:
                for i in range(3):
                    total += b[k, i] * covariance[column + i, at]
            row[j] = total
        for other in range(k + 1):
            total = 0.0
            for j in range(UE):
                total += row[j] * a[other, j]
            if source > 0:
                for j in range(3):
                    total += row[UE + j] * b[other, j]
            projected[k, other] = total
            projected[other, k] = total


@jit
def log_likelihoods(
    projected: FloatArray,
    expected: FloatArray,
    degenerate: BoolArray,
    observed: Observed,
    gates: FloatArray,
    innovation: FloatArray,
    log_likelihood: FloatArray,
) -> bool:
    """ln N(z_j; h_m, S_m + R_j) of all pairs over the components that count.

    Args:
        projected: (M, 6, 6) covariance of h.
        expected: (M, 6) h.
        degenerate: (M,) sources of which nothing can be said.
        observed: J paths.
        gates: (7,) largest squared distance by the number of components.
        innovation: (M, J, 6) result: z - h, azimuths wrapped, zero where it does not count.
        log_likelihood: (M, J) result, -inf outside the gate.

    Returns:
        Whether all covariances were positive definite.
    """
    values, used, noise = observed.values, observed.used, observed.noise
    sound = True
    s = np.empty((DIM, DIM))
    v = np.empty(DIM)
    places = np.empty(DIM, np.int64)
    for j in range(values.shape[0]):
        count = used_places(used[j], places)
        gate = gates[count]
        for m in range(expected.shape[0]):
            log_likelihood[m, j] = -np.inf
            outside = degenerate[m]
            for c in range(DIM):
                difference = 0.0
                if used[j, c]:
                    difference = values[j, c] - expected[m, c]
                    if c in (ARRIVAL, DEPARTURE):
                        difference = wrapped(difference)
                    # The distance in one component is never larger than that in all.
                    variance = projected[m, c, c] + noise[j, c, c]
                    if difference * difference > gate * variance:
                        outside = True
                innovation[m, j, c] = difference
            if outside:
                continue
            for k in range(count):
                v[k] = innovation[m, j, places[k]]
                for i in range(k + 1):
                    s[k, i] = projected[m, places[k], places[i]] + noise[j, places[k], places[i]]
            if not cholesky(s, count):
                sound = False
                continue
            forward(s, v, count)
            distance = 0.0
            for k in range(count):
                distance += v[k] * v[k]
            if distance <= gate:
                constant = count * LOG_2PI + log_determinant(s, count)
                log_likelihood[m, j] = -0.5 * (distance + constant)
    return sound


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
        ue_jacobian: (C + 1, 6, 4) A = dh/ds.
        landmark_jacobian: (C + 1, 6, 3) B = dh/dq, zero for the BS.
        detection: (C + 1,) p_D.
        innovation: (C + 1, J, 6) z - h, zero where not used.
        log_likelihood: (C + 1, J) ln N(z; h, S); -inf outside the gate.
    """

    ue_jacobian: FloatArray
    landmark_jacobian: FloatArray
    detection: FloatArray
    innovation: FloatArray
    log_likelihood: FloatArray
