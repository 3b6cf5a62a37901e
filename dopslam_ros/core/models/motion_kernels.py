"""The vehicle's motion over controls in a row."""

from __future__ import annotations

import math

import numpy as np

from dopslam_ros.core.linalg.arrays import FloatArray
from dopslam_ros.core.linalg.jit import from_python, jit
from dopslam_ros.core.models.channel_kernels import wrapped
from dopslam_ros.core.settings.layout import HEADING, X, Y


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
    """Moves a state (U,) by f of eq. (1); returns its displacement x, y [m]."""
    dx, dy = chord(state[HEADING], speed, turn_rate, duration)
    state[X] += dx
    state[Y] += dy
    state[HEADING] = wrapped(state[HEADING] + turn_rate * duration)
    return dx, dy


@from_python
def propagate(states: FloatArray, speed: float, turn_rate: float, duration: float) -> None:
    """``move`` for states (M, U)."""
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
    """Moves a state over controls in a row, by f of eq. (1), with its derivative F and the noise Q.

    Args:
        state: (U,) to be moved.
        spans: (S, 5) speed [m/s], turn rate [rad/s], duration [s], and the variances that come on
            top along the heading [m^2] and of the heading [rad^2].
        noise_rate: (U,) variance that the process noise adds per second.
        jacobian: (U, U) F, unit at first.
        noise: (U, U) Q, zero at first.
    """
    size = len(state)
    for n in range(len(spans)):
        duration = spans[n, 2]
        middle = state[HEADING] + 0.5 * spans[n, 1] * duration
        dx, dy = move(state, spans[n, 0], spans[n, 1], duration)
        # F of a span is unit but for dx / dheading = -dy and dy / dheading = dx.
        jacobian[X, HEADING] -= dy
        jacobian[Y, HEADING] += dx
        for k in range(size):
            noise[X, k] -= dy * noise[HEADING, k]
            noise[Y, k] += dx * noise[HEADING, k]
        for k in range(size):
            noise[k, X] -= dy * noise[k, HEADING]
            noise[k, Y] += dx * noise[k, HEADING]
            noise[k, k] += noise_rate[k] * duration
        if spans[n, 3] > 0.0:
            c, s = math.cos(middle), math.sin(middle)
            noise[X, X] += spans[n, 3] * c * c
            noise[X, Y] += spans[n, 3] * c * s
            noise[Y, X] += spans[n, 3] * c * s
            noise[Y, Y] += spans[n, 3] * s * s
        noise[HEADING, HEADING] += spans[n, 4]


@from_python
def predict_covariance(
    covariance: FloatArray, jacobian: FloatArray, noise: FloatArray, after: FloatArray
) -> None:
    """F P F' + Q where only the vehicle, the first U of n, moves.

    Args:
        covariance: (n, n) P, symmetric.
        jacobian: (U, U) F of the vehicle.
        noise: (U, U) Q of the vehicle.
        after: (n, n) P, of which the rows and columns of the vehicle are to be written.
    """
    size = len(jacobian)
    moved = np.empty((size, size))  # F P of the vehicle
    for i in range(size):
        for k in range(len(after)):
            entry = 0.0
            for m in range(size):
                entry += jacobian[i, m] * covariance[m, k]
            if k < size:
                moved[i, k] = entry
            else:
                after[i, k] = entry
                after[k, i] = entry
    for i in range(size):
        for j in range(i + 1):
            entry = noise[i, j]
            for m in range(size):
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
        noise_rate: (U,) variance that the process noise adds per second.
    """
    size = len(noise_rate)
    moved, after, jacobian = mean.copy(), covariance.copy(), np.eye(size)
    noise = np.zeros((size, size))
    propagate_spans(moved[:size], spans, noise_rate, jacobian, noise)
    predict_covariance(covariance, jacobian, noise, after)
    return moved, after
