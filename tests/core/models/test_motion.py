"""Motion: eq. (1) as it is printed, numerical integration and differences as witnesses."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from dopslam_ros.core.linalg.arrays import FloatArray, wrap_angle
from dopslam_ros.core.linalg.jit import from_python
from dopslam_ros.core.models import motion
from dopslam_ros.core.models.motion import Control, ControlSpan, Motion, propagate, span_rows

predict_covariance = from_python(motion.predict_covariance)
_propagate_spans = from_python(motion.propagate_spans)

STATE = np.array([70.7, -3.0, 1.2, 300.0])


def propagate_spans(
    state: FloatArray, spans: Sequence[ControlSpan], noise_rate: FloatArray
) -> Motion:
    return _propagate_spans(state, span_rows(spans), noise_rate)


def propagation_jacobian(state: FloatArray, control: Control, duration: float) -> FloatArray:
    """F of a single span."""
    return propagate_spans(state, [ControlSpan(control, duration)], np.zeros(len(state))).jacobian


def printed(state: FloatArray, control: Control, duration: float) -> FloatArray:
    """f of eq. (1) as the paper prints it; not for omega = 0."""
    v, omega = control
    x, y, heading, bias = state
    chord = 2.0 * v / omega * math.sin(omega * duration / 2.0)
    middle = heading + omega * duration / 2.0
    return np.array(
        [
            x + chord * math.cos(middle),
            y + chord * math.sin(middle),
            heading + omega * duration,
            bias,
        ]
    )


@pytest.mark.parametrize("seed", range(20))
def test_propagate_is_the_printed_equation(seed: int) -> None:
    rng = np.random.default_rng(seed)
    state = rng.normal(0.0, [50.0, 50.0, 2.0, 100.0])
    control = Control(rng.uniform(-30.0, 30.0), rng.choice([-1.0, 1.0]) * rng.uniform(0.01, 3.0))
    duration = rng.uniform(0.01, 3.0)
    expected = printed(state, control, duration)
    actual = propagate(state, control, duration)
    np.testing.assert_allclose(actual[[0, 1, 3]], expected[[0, 1, 3]], rtol=1e-12, atol=1e-10)
    assert abs(wrap_angle(actual[2] - expected[2])) < 1e-12
    assert -math.pi < actual[2] <= math.pi


@pytest.mark.parametrize("turn_rate", [0.0, 0.3, -1.7])
def test_propagate_integrates_the_motion(turn_rate: float) -> None:
    def rates(_: float, s: FloatArray) -> list[float]:
        return [22.22 * math.cos(s[2]), 22.22 * math.sin(s[2]), turn_rate, 0.0]

    end = solve_ivp(rates, (0.0, 0.7), STATE, rtol=1e-10, atol=1e-10).y[:, -1]
    np.testing.assert_allclose(propagate(STATE, Control(22.22, turn_rate), 0.7), end, atol=1e-6)


@pytest.mark.parametrize("turn_rate", [1e-3, 1e-6, 1e-9, 1e-12, 1e-300, -1e-9])
def test_the_limit_of_no_turn_is_continuous(turn_rate: float) -> None:
    straight = propagate(STATE, Control(22.22, 0.0), 0.5)
    along = STATE[:2] + 11.11 * np.array([math.cos(1.2), math.sin(1.2)])
    np.testing.assert_allclose(straight[:2], along, rtol=1e-14)
    turned = propagate(STATE, Control(22.22, turn_rate), 0.5)
    assert np.abs(turned - straight).max() <= 11.11 * abs(turn_rate) + 1e-12
    difference = propagation_jacobian(STATE, Control(22.22, turn_rate), 0.5)
    difference = difference - propagation_jacobian(STATE, Control(22.22, 0.0), 0.5)
    assert np.abs(difference).max() <= 11.11 * abs(turn_rate) + 1e-12


@pytest.mark.parametrize("seed", range(20))
def test_jacobian_against_central_differences(seed: int) -> None:
    rng = np.random.default_rng(seed)
    state = rng.normal(0.0, [50.0, 50.0, 1.0, 100.0])
    control = Control(rng.uniform(-30.0, 30.0), rng.uniform(-1.0, 1.0) * (seed % 4 > 0))
    step = 1e-5
    expected = np.empty((4, 4))
    for column in range(4):
        offset = step * np.eye(4)[column]
        ahead = propagate(state + offset, control, 0.8)
        behind = propagate(state - offset, control, 0.8)
        difference = ahead - behind
        difference[2] = wrap_angle(difference[2])
        expected[:, column] = difference / (2.0 * step)
    np.testing.assert_allclose(propagation_jacobian(state, control, 0.8), expected, atol=1e-7)


def test_a_batch_is_its_members() -> None:
    batch = np.random.default_rng(3).normal(0.0, 10.0, (5, 7, 4))
    control = Control(10.0, 0.4)
    moved = propagate(batch, control, 0.5)
    for index in np.ndindex(5, 7):
        np.testing.assert_allclose(moved[index], propagate(batch[index], control, 0.5), rtol=1e-14)


def test_propagate_leaves_its_argument_alone() -> None:
    before = STATE.copy()
    propagate(STATE, Control(22.22, 3.0), 10.0)
    np.testing.assert_array_equal(STATE, before)


RATE = np.array([0.08, 0.05, 2e-6, 0.07])


def test_spans_of_one_control_compose() -> None:
    control = Control(22.22, 0.314)
    whole = propagate_spans(STATE, [ControlSpan(control, 0.5)], RATE)
    parts = propagate_spans(
        STATE, [ControlSpan(control, t) for t in (0.1, 0.05, 0.0, 0.3, 0.05)], RATE
    )
    np.testing.assert_allclose(parts[0], whole[0], rtol=1e-12)
    np.testing.assert_allclose(parts[1], whole[1], rtol=1e-10, atol=1e-12)
    # The noise enters along the way, so it spreads a little more; its trace in time is the same.
    np.testing.assert_allclose(np.diag(parts[2])[2:], (RATE * 0.5)[2:], rtol=1e-12)
    np.testing.assert_allclose(parts[2], whole[2], atol=1e-3)


def test_spans_are_the_steps_one_after_the_other() -> None:
    spans = [
        ControlSpan(Control(20.0, 0.3), 0.2),
        ControlSpan(Control(5.0, 0.0), 0.4),
        ControlSpan(Control(-8.0, -1.0), 0.1),
    ]
    state, jacobian, noise = propagate_spans(STATE, spans, RATE)
    expected, f, q = STATE, np.eye(4), np.zeros((4, 4))
    for control, duration, _ in spans:
        one = propagation_jacobian(expected, control, duration)
        f, q = one @ f, one @ q @ one.T + np.diag(RATE) * duration
        expected = propagate(expected, control, duration)
    np.testing.assert_allclose(state, expected)
    np.testing.assert_allclose(jacobian, f)
    np.testing.assert_allclose(noise, q)


def test_noise_of_spans_against_sampling() -> None:
    spans = [ControlSpan(Control(40.0, 0.5), 1.0), ControlSpan(Control(40.0, -0.5), 1.0)]
    rate = np.array([0.01, 0.02, 1e-3, 0.03])
    mean, _, noise = propagate_spans(STATE, spans, rate)
    rng = np.random.default_rng(11)
    samples = np.tile(STATE, (40_000, 1))
    for control, duration, _ in spans:
        samples = propagate(samples, control, duration)
        samples = samples + rng.normal(0.0, np.sqrt(rate * duration), samples.shape)
    error = samples - mean
    error[:, 2] = wrap_angle(error[:, 2])
    sampled = error.T @ error / len(error)
    scale = np.sqrt(np.outer(np.diag(noise), np.diag(noise)))
    np.testing.assert_allclose(sampled / scale, noise / scale, atol=0.03)


@pytest.mark.parametrize("size", [4, 5, 31])
def test_the_covariance_moves_with_the_vehicle_only(size: int) -> None:
    rng = np.random.default_rng(size)
    root, step, noise = rng.normal(size=(size, size)), rng.normal(size=(4, 4)), rng.normal(size=4)
    covariance = root @ root.T
    before = covariance.copy()
    f, q = np.eye(size), np.zeros((size, size))
    f[:4, :4], q[:4, :4] = step, np.diag(noise**2)
    moved = predict_covariance(covariance, step, np.diag(noise**2))
    np.testing.assert_allclose(moved, f @ covariance @ f.T + q, rtol=1e-10, atol=1e-10)
    np.testing.assert_array_equal(moved, moved.T)
    np.testing.assert_array_equal(covariance, before)


def test_a_fifth_component_walks_at_random() -> None:
    state, rate = np.append(STATE, 7.0), np.append(RATE, 0.3)
    spans = [ControlSpan(Control(20.0, 0.3), 0.2), ControlSpan(Control(5.0, 0.0), 0.4)]
    longer, plain = propagate_spans(state, spans, rate), propagate_spans(STATE, spans, RATE)
    assert longer.state[4] == 7.0
    for ours, theirs in zip(plain[1:], longer[1:], strict=True):
        np.testing.assert_array_equal(theirs[:4, :4], ours)
        assert not theirs[4, :4].any() and not theirs[:4, 4].any()
    assert longer.jacobian[4, 4] == 1.0
    assert longer.noise[4, 4] == pytest.approx(0.3 * 0.6)


def test_no_span_is_no_motion() -> None:
    state, jacobian, noise = propagate_spans(STATE, [], RATE)
    np.testing.assert_array_equal(state, STATE)
    np.testing.assert_array_equal(jacobian, np.eye(4))
    np.testing.assert_array_equal(noise, np.zeros((4, 4)))


@pytest.mark.parametrize(
    ("angle", "wrapped"),
    [(math.pi, math.pi), (-math.pi, math.pi), (3.5 * math.pi, -0.5 * math.pi), (0.25, 0.25)],
)
def test_wrap_angle(angle: float, wrapped: float) -> None:
    assert wrap_angle(np.array([angle]))[0] == pytest.approx(wrapped)
    assert np.isnan(wrap_angle(np.array([np.nan]))[0])
