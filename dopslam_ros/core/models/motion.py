"""Motion of the vehicle: constant turn rate and speed over each piece of time (eq. 1)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from dopslam_ros.core.linalg.arrays import FloatArray
from dopslam_ros.core.linalg.jit import from_python, jit
from dopslam_ros.core.models.channel_kernels import wrapped
from dopslam_ros.core.settings.layout import HEADING, X, Y


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
    propagate_states(
        after.reshape(-1, after.shape[-1]),
        float(control.speed),
        float(control.turn_rate),
        float(duration),
    )
    return after


@from_python
def propagate_states(states: FloatArray, speed: float, turn_rate: float, duration: float) -> None:
    """``propagate`` for states (M, U), in place."""
    for m in range(len(states)):
        move(states[m], speed, turn_rate, duration)


@jit
def move(state: FloatArray, speed: float, turn_rate: float, duration: float) -> tuple[float, float]:
    """Moves a state (U,) by f of eq. (1); returns its displacement x, y [m]."""
    dx, dy = chord(state[HEADING], speed, turn_rate, duration)
    state[X] += dx
    state[Y] += dy
    state[HEADING] = wrapped(state[HEADING] + turn_rate * duration)
    return dx, dy


@jit
def chord(heading: float, speed: float, turn_rate: float, duration: float) -> tuple[float, float]:
    """Displacement x, y [m] of eq. (1), in the form sin(a) / a that is smooth at omega = 0."""
    half = 0.5 * turn_rate * duration
    length = speed * duration
    if half != 0.0:
        length *= math.sin(half) / half
    return length * math.cos(heading + half), length * math.sin(heading + half)


# The columns of spans as arrays.
SPEED, TURN_RATE, DURATION, ALONG_VARIANCE, HEADING_VARIANCE = range(5)


def span_rows(spans: Sequence[ControlSpan]) -> FloatArray:
    """(S, 5) spans: speed [m/s], turn rate [rad/s], duration [s], and the variances of their drift.

    These come on top, along the heading [m^2] and of the heading [rad^2].
    """
    rows = np.array([(*c, duration, *drift) for c, duration, drift in spans], dtype=np.float64)
    return rows.reshape(-1, 5)


class Motion(NamedTuple):
    """How the vehicle's U components move over some time.

    Attributes:
        state: (U,) after it.
        jacobian: (U, U) F, the derivative of that by the state before.
        noise: (U, U) Q, the process noise that comes on top.
    """

    state: FloatArray
    jacobian: FloatArray
    noise: FloatArray


@jit
def propagate_spans(state: FloatArray, spans: FloatArray, noise_rate: FloatArray) -> Motion:
    """The motion over controls in a row, by f of eq. (1), with its derivative F and the noise Q.

    Q follows each F and grows with time: Q <- F Q F' + noise_rate duration. What only the noise
    moves walks at random.

    Args:
        state: (U,) before.
        spans: (S, 5) as ``span_rows`` makes them.
        noise_rate: (U,) variance that the process noise adds per second.
    """
    size = len(state)
    after, jacobian, noise = state.copy(), np.eye(size), np.zeros((size, size))
    for n in range(len(spans)):
        duration = spans[n, DURATION]
        middle = after[HEADING] + 0.5 * spans[n, TURN_RATE] * duration
        dx, dy = move(after, spans[n, SPEED], spans[n, TURN_RATE], duration)
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
        add_drift(middle, spans[n, ALONG_VARIANCE], spans[n, HEADING_VARIANCE], noise)
    return Motion(after, jacobian, noise)


@jit
def add_drift(
    heading: float, along_variance: float, heading_variance: float, noise: FloatArray
) -> None:
    """Adds to Q what is lost along a heading [rad], [m^2], and of the heading, [rad^2]."""
    if along_variance > 0.0:
        c, s = math.cos(heading), math.sin(heading)
        noise[X, X] += along_variance * c * c
        noise[X, Y] += along_variance * c * s
        noise[Y, X] += along_variance * c * s
        noise[Y, Y] += along_variance * s * s
    noise[HEADING, HEADING] += heading_variance


@from_python
def predict(
    mean: FloatArray, covariance: FloatArray, spans: FloatArray, noise_rate: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Mean (n,) and covariance (n, n) after controls in a row: the vehicle moves, the map does not.

    Args:
        mean: (n,) before, the U components of the vehicle first.
        covariance: (n, n) before.
        spans: (S, 5) as ``span_rows`` makes them.
        noise_rate: (U,) variance that the process noise adds per second.
    """
    size = len(noise_rate)
    motion, after = propagate_spans(mean[:size], spans, noise_rate), mean.copy()
    for k in range(size):
        after[k] = motion.state[k]
    return after, predict_covariance(covariance, motion.jacobian, motion.noise)


@jit
def predict_covariance(
    covariance: FloatArray, jacobian: FloatArray, noise: FloatArray
) -> FloatArray:
    """F P F' + Q (n, n) where only the vehicle moves, the first U of n components.

    Args:
        covariance: (n, n) P, symmetric.
        jacobian: (U, U) F of the vehicle.
        noise: (U, U) Q of the vehicle.
    """
    size, after = len(jacobian), covariance.copy()
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
    return after
