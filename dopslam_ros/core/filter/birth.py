"""New landmarks from single paths: where they would be, how sure, and how likely they are new."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from dopslam_ros.core.arrays import BoolArray, FloatArray, floats
from dopslam_ros.core.filter.evidence import Observed
from dopslam_ros.core.filter.state import UE, UNKNOWN_TYPES, FilterParameters, FilterState
from dopslam_ros.core.filter.undetected import log_share_left
from dopslam_ros.core.kernels import birth, detection, incidence

TYPES = np.array(UNKNOWN_TYPES, dtype=np.int64)


@dataclass(frozen=True)
class Births:
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
    start, located = initial_incidence_points(state.ue_mean, observed, parameters)
    shape = (len(TYPES), len(located))
    position, covariance = np.empty((*shape, 3)), np.zeros((*shape, 3, 3))
    gain, spread = np.zeros((*shape, 3, UE)), np.zeros(shape)
    log_evidence = np.full(shape, -np.inf)
    birth.propose(
        floats(state.ue_mean),
        floats(state.ue_covariance),
        float(speed),
        floats(parameters.bs),
        float(parameters.ue_height),
        float(parameters.landmark_height_mean),
        float(parameters.landmark_height_std),
        floats(observed.values),
        observed.used,
        floats(observed.noise),
        start,
        located,
        TYPES,
        position,
        covariance,
        gain,
        spread,
        log_evidence,
    )
    log_undetected = _log_undetected(state, position.reshape(-1, 3), spread.ravel(), parameters)
    return Births(position, covariance, gain, log_evidence + log_undetected.reshape(shape))


def _log_undetected(
    state: FilterState, positions: FloatArray, spread: FloatArray, parameters: FilterParameters
) -> FloatArray:
    """ln (lambda p_D) at places (M, 3), M / 2 of each type, with std (M,) of the distance [m]."""
    types = np.repeat(TYPES, len(positions) // len(TYPES))
    log_share = log_share_left(
        state.undetected, positions, types, spread, parameters, parameters.undetected_floor
    )
    detection.add_log_detection(
        state.mean,
        parameters.ue_height,
        positions,
        types,
        spread,
        parameters.detection_probability,
        parameters.sp_field_of_view,
        log_share,
    )
    return log_share + math.log(parameters.undetected_intensity)


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
    points = np.empty((len(observed.values), 3))
    located = np.empty(len(points), dtype=np.bool_)
    incidence.incidence_points(
        floats(ue_state),
        float(parameters.ue_height),
        floats(parameters.bs),
        float(parameters.landmark_height_mean),
        floats(observed.values),
        points,
        located,
    )
    return points, located
