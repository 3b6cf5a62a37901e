"""Motion of the vehicle: constant turn rate and speed over each piece of time (eq. 1)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from dopslam_ros.core.arrays import FloatArray, symmetrise, wrap_angle


class Control(NamedTuple):
    """What the vehicle does for a while.

    Attributes:
        speed: v, along the heading [m/s].
        turn_rate: omega, counter-clockwise [rad/s].
    """

    speed: float
    turn_rate: float


class ControlSpan(NamedTuple):
    """A control and how long it holds [s]."""

    control: Control
    duration: float


def propagate(state: FloatArray, control: Control, duration: float) -> FloatArray:
    """f of eq. (1), in the sinc form that needs no special case at omega = 0.

    Args:
        state: (..., 4) x [m], y [m], heading [rad], clock bias [m]; map frame.
        control: speed and turn rate.
        duration: T [s].

    Returns:
        (..., 4) the state after ``duration``; heading wrapped.
    """
    half = 0.5 * control.turn_rate * duration
    chord = control.speed * duration * np.sinc(half / np.pi)
    direction = state[..., 2] + half
    after = np.array(state, dtype=np.float64)
    after[..., 0] += chord * np.cos(direction)
    after[..., 1] += chord * np.sin(direction)
    after[..., 2] = wrap_angle(state[..., 2] + control.turn_rate * duration)
    return after


def propagation_jacobian(state: FloatArray, control: Control, duration: float) -> FloatArray:
    """F = df/ds of eq. (1), (4, 4), at ``state`` (4,)."""
    half = 0.5 * control.turn_rate * duration
    chord = control.speed * duration * np.sinc(half / np.pi)
    direction = state[2] + half
    jacobian = np.eye(4)
    jacobian[0, 2] = -chord * np.sin(direction)
    jacobian[1, 2] = chord * np.cos(direction)
    return jacobian


def propagate_spans(
    state: FloatArray, spans: Sequence[ControlSpan], noise_rate: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The motion over several controls in a row.

    Args:
        state: (4,) before.
        spans: the controls, in order of time.
        noise_rate: (4,) variance that the process noise Q adds per second.

    Returns:
        (4,) the state after, (4, 4) the Jacobian of the whole motion, (4, 4) its process noise.
    """
    jacobian = np.eye(4)
    noise = np.zeros((4, 4))
    for control, duration in spans:
        step = propagation_jacobian(state, control, duration)
        noise = step @ noise @ step.T + np.diag(noise_rate * duration)
        jacobian = step @ jacobian
        state = propagate(state, control, duration)
    return state, jacobian, noise


def predict_covariance(
    covariance: FloatArray, jacobian: FloatArray, noise: FloatArray
) -> FloatArray:
    """Covariance of [s; x_1 ...] after the vehicle has moved: F P F' + Q, the map is static.

    Args:
        covariance: (n, n) before, the vehicle first.
        jacobian: (4, 4) F of the motion.
        noise: (4, 4) Q of the motion.

    Returns:
        (n, n).
    """
    after = np.array(covariance)
    after[:4] = jacobian @ after[:4]
    after[:, :4] = after[:, :4] @ jacobian.T
    after[:4, :4] += noise
    return symmetrise(after)
