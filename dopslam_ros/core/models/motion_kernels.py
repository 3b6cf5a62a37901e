"""The vehicle's motion over controls in a row."""

from __future__ import annotations

import math

import numpy as np

from dopslam_ros.core.linalg.arrays import FloatArray
from dopslam_ros.core.linalg.jit import from_python, jit
from dopslam_ros.core.models.channel_kernels import wrapped


@from_python
def chord(heading: float, speed: float, turn_rate: float, duration: float) -> tuple[float, float]:
    """Displacement x, y [m] of eq. (1), in the form sin(a) / a that is smooth at omega = 0."""
    half = 0.5 * turn_rate * duration
    length = speed * duration
    if half != 0.0:
        length *= math.sin(half) / half
    return length * math.cos(heading + half), length * math.sin(heading + half)


@jit
def move(state: FloatArray, speed: float, turn_rate: float, duration: float) -> tuple[float, float]:
    """Moves a state (4,) by f of eq. (1); returns its displacement x, y [m]."""
    dx, dy = chord(state[2], speed, turn_rate, duration)
    state[0] += dx
    state[1] += dy
    state[2] = wrapped(state[2] + turn_rate * duration)
    return dx, dy


@from_python
def propagate(states: FloatArray, speed: float, turn_rate: float, duration: float) -> None:
    """``move`` for states (M, 4)."""
    for m in range(len(states)):
        move(states[m], speed, turn_rate, duration)


@from_python
def propagate_spans(
    state: FloatArray,
    spans: FloatArray,
    noise_rate: FloatArray,
    jacobian: FloatArray,
    noise: FloatArray,
) -> None:
    """Moves a state over controls in a row.

    Args:
        state: (4,) to be moved.
        spans: (S, 5) speed [m/s], turn rate [rad/s], duration [s], and the variances that come on
            top along the heading [m^2] and of the heading [rad^2].
        noise_rate: (4,) variance that the process noise adds per second.
        jacobian: (4, 4) F, unit at first.
        noise: (4, 4) Q, zero at first.
    """
    for n in range(len(spans)):
        duration = spans[n, 2]
        middle = state[2] + 0.5 * spans[n, 1] * duration
        dx, dy = move(state, spans[n, 0], spans[n, 1], duration)
        # F of a span is unit but for F[0, 2] = -dy and F[1, 2] = dx.
        jacobian[0, 2] -= dy
        jacobian[1, 2] += dx
        for k in range(4):
            noise[0, k] -= dy * noise[2, k]
            noise[1, k] += dx * noise[2, k]
        for k in range(4):
            noise[k, 0] -= dy * noise[k, 2]
            noise[k, 1] += dx * noise[k, 2]
            noise[k, k] += noise_rate[k] * duration
        if spans[n, 3] > 0.0:
            c, s = math.cos(middle), math.sin(middle)
            noise[0, 0] += spans[n, 3] * c * c
            noise[0, 1] += spans[n, 3] * c * s
            noise[1, 0] += spans[n, 3] * c * s
            noise[1, 1] += spans[n, 3] * s * s
        noise[2, 2] += spans[n, 4]


@from_python
def predict_covariance(
    covariance: FloatArray, jacobian: FloatArray, noise: FloatArray, after: FloatArray
) -> None:
    """F P F' + Q where only the vehicle, the first four of n, moves.

    Args:
        covariance: (n, n) P, symmetric.
        jacobian: (4, 4) F of the vehicle.
        noise: (4, 4) Q of the vehicle.
        after: (n, n) P, of which the rows and columns of the vehicle are to be written.
    """
    moved = np.empty((4, 4))  # F P of the vehicle
    for i in range(4):
        for k in range(len(after)):
            entry = 0.0
            for m in range(4):
                entry += jacobian[i, m] * covariance[m, k]
            if k < 4:
                moved[i, k] = entry
            else:
                after[i, k] = entry
                after[k, i] = entry
    for i in range(4):
        for j in range(i + 1):
            entry = noise[i, j]
            for m in range(4):
                entry += moved[i, m] * jacobian[j, m]
            after[i, j] = entry
            after[j, i] = entry


@from_python
def predict(
    mean: FloatArray, covariance: FloatArray, spans: FloatArray, noise_rate: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Mean (n,) and covariance (n, n) after controls in a row: the vehicle moves, the map does not.

    Args:
        mean: (n,) before.
        covariance: (n, n) before.
        spans: (S, 5) as in ``propagate_spans``.
        noise_rate: (4,) variance that the process noise adds per second.
    """
    moved, after, jacobian = mean.copy(), covariance.copy(), np.eye(4)
    noise = np.zeros((4, 4))
    propagate_spans(moved[:4], spans, noise_rate, jacobian, noise)
    predict_covariance(covariance, jacobian, noise, after)
    return moved, after
