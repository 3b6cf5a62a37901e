"""Motion of the vehicle: constant turn rate and speed over each piece of time (eq. 1)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from dopslam_ros.core.linalg.arrays import FloatArray, check_shapes, floats
from dopslam_ros.core.models import motion_kernels as kernels
from dopslam_ros.core.settings.layout import HEADING, VEHICLE, X, Y


class Control(NamedTuple):
    """What the vehicle does for a while.

    Attributes:
        speed: v, along the heading [m/s].
        turn_rate: omega, counter-clockwise [rad/s].
    """

    speed: float
    turn_rate: float


class Drift(NamedTuple):
    """How far the vehicle may have left what an old control says, beyond the process noise.

    Attributes:
        along: variance along the heading [m^2].
        heading: variance of the heading [rad^2].
    """

    along: float
    heading: float


NO_DRIFT = Drift(0.0, 0.0)


class ControlSpan(NamedTuple):
    """A control, how long it holds [s], and what is lost when it is an old one."""

    control: Control
    duration: float
    drift: Drift = NO_DRIFT


def propagate(state: FloatArray, control: Control, duration: float) -> FloatArray:
    """f of eq. (1), in the sinc form that needs no special case at omega = 0.

    Args:
        state: (..., U) components of the vehicle (``layout.VEHICLE``); map frame.
        control: speed and turn rate.
        duration: T [s].

    Returns:
        (..., U) the state after ``duration``; heading wrapped.
    """
    after = np.array(state, dtype=np.float64, order="C")
    kernels.propagate(
        after.reshape(-1, after.shape[-1]),
        float(control.speed),
        float(control.turn_rate),
        float(duration),
    )
    return after


def propagation_jacobian(state: FloatArray, control: Control, duration: float) -> FloatArray:
    """F = df/ds of eq. (1), (U, U), at ``state`` (U,)."""
    speed, turn_rate = float(control.speed), float(control.turn_rate)
    dx, dy = kernels.chord(float(state[HEADING]), speed, turn_rate, float(duration))
    jacobian = np.eye(len(state))
    jacobian[X, HEADING] = -dy
    jacobian[Y, HEADING] = dx
    return jacobian


def propagate_spans(
    state: FloatArray, spans: Sequence[ControlSpan], noise_rate: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The motion over several controls in a row.

    Args:
        state: (U,) before.
        spans: the controls, in order of time.
        noise_rate: (U,) variance that the process noise Q adds per second.

    Returns:
        (U,) the state after, (U, U) the Jacobian of the whole motion, (U, U) its process noise.
    """
    size = max(len(state), len(VEHICLE))
    check_shapes(state=(state, (size,)), noise_rate=(noise_rate, (size,)))
    after, jacobian = np.array(state, dtype=np.float64), np.eye(size)
    noise = np.zeros((size, size))
    kernels.propagate_spans(after, span_rows(spans), floats(noise_rate), jacobian, noise)
    return after, jacobian, noise


def span_rows(spans: Sequence[ControlSpan]) -> FloatArray:
    """(S, 5) the spans as ``kernels.motion.propagate_spans`` takes them."""
    rows = np.array([(*c, duration, *drift) for c, duration, drift in spans], dtype=np.float64)
    return rows.reshape(-1, 5)


def predict_covariance(
    covariance: FloatArray, jacobian: FloatArray, noise: FloatArray
) -> FloatArray:
    """Covariance of [s; x_1 ...] after the vehicle has moved: F P F' + Q, the map is static.

    Args:
        covariance: (n, n) before, symmetric, the vehicle first.
        jacobian: (U, U) F of the motion.
        noise: (U, U) Q of the motion.

    Returns:
        (n, n).
    """
    size, vehicle = len(covariance), len(jacobian)
    check_shapes(
        covariance=(covariance, (max(size, vehicle), size)),
        jacobian=(jacobian, (vehicle, vehicle)),
        noise=(noise, (vehicle, vehicle)),
    )
    after = np.array(covariance, dtype=np.float64, order="C")
    kernels.predict_covariance(floats(covariance), floats(jacobian), floats(noise), after)
    return after
