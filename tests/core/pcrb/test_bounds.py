"""Bounds: the published figure, eq. (17) with explicit inverses, and what must hold anyway."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from dopslam_ros.core.linalg.arrays import BoolArray, FloatArray
from dopslam_ros.core.linalg.jit import from_python
from dopslam_ros.core.models import motion
from dopslam_ros.core.models.channel import observe
from dopslam_ros.core.models.motion import Control, ControlSpan, propagate, span_rows
from dopslam_ros.core.pcrb.bounds import (
    Bounds,
    BoundState,
    bounds_of,
    information_split,
    initial_bound,
    predict_bound,
    update_bound,
)
from dopslam_ros.core.session.bounding import BoundsOutput, BoundsSession, WorldState
from dopslam_ros.core.settings.layout import DIM, LandmarkType
from dopslam_ros.core.settings.model import with_doppler_std
from dopslam_ros.lab.published import published
from dopslam_ros.simulation.matched import bounds_parameters_for, nominal_bounds
from dopslam_ros.simulation.scenario import Blockage, Scenario, load_scenario
from dopslam_ros.simulation.simulator import all_landmarks, nominal_trajectory, visible

propagate_spans = from_python(motion.propagate_spans)

SIGMAS = [0.05, 0.1, 0.2, 0.3, 0.4, 0.5, None]
IDS = np.arange(9)
ALL = np.ones(DIM, dtype=bool)


def recursion(scenario: Scenario, steps: int | None = None) -> BoundState:
    """Eq. (17) along the path without noise, every visible landmark detected."""
    positions, types = all_landmarks(scenario)
    states = nominal_trajectory(scenario)[:steps]
    bound = initial_bound(scenario.initial_covariance)
    for step, state in enumerate(states):
        control = scenario.controls[step]
        if step:
            span = ControlSpan(scenario.controls[step - 1], scenario.period)
            bound = predict_bound(bound, states[step - 1], [span], scenario.noise_rate)
        paths = observe(state, control.speed, positions, types, scenario.bs)
        seen = visible(scenario, state, step).astype(float)
        bound = update_bound(
            bound, paths, IDS, types, seen, scenario.noise, scenario.used_components
        )
    return bound


def motion_jacobian(state: FloatArray, control: Control, duration: float) -> FloatArray:
    spans = span_rows([ControlSpan(control, duration)])
    return propagate_spans(state, spans, np.zeros(len(state))).jacobian


def session_outputs(scenario: Scenario) -> list[BoundsOutput]:
    session = BoundsSession(bounds_parameters_for(scenario))
    positions, types = all_landmarks(scenario)
    outputs: list[BoundsOutput] = []
    for step, state in enumerate(nominal_trajectory(scenario)):
        stamp, control = scenario.stamp_ns(step), scenario.controls[step]
        seen = visible(scenario, state, step)
        outputs += session.add_world(stamp, WorldState(state, IDS, types, positions, seen))
        outputs += session.add_control(stamp, control.speed, control.turn_rate)
    return outputs


def four(bounds: Bounds) -> list[float]:
    return [bounds.peb, math.degrees(bounds.heb), bounds.ceb, float(np.mean(bounds.leb))]


@pytest.mark.parametrize("sigma_d", SIGMAS)
def test_the_published_bounds_within_ten_percent(sigma_d: float | None) -> None:
    scenario = with_doppler_std(load_scenario("paper_bounds"), sigma_d)
    direct = four(bounds_of(recursion(scenario), IDS[1:]))
    expected = published().bounds_at(sigma_d)
    assert expected is not None
    np.testing.assert_allclose(direct, expected, rtol=0.1)
    # The session and the study go the same way.
    last = session_outputs(scenario)[-1]
    np.testing.assert_allclose(four(last.with_doppler), direct, rtol=1e-9)
    np.testing.assert_allclose(four(nominal_bounds(scenario)), direct, rtol=1e-9)


def test_the_session_also_tells_the_published_bounds_without_doppler() -> None:
    last = session_outputs(load_scenario("paper_bounds"))[-1]
    expected = published().bounds_at(None)
    assert expected is not None
    np.testing.assert_allclose(four(last.without_doppler), expected, rtol=0.1)


def dense(
    prior: FloatArray, steps: list[tuple[FloatArray, FloatArray, FloatArray, BoolArray]]
) -> FloatArray:
    """J^-1 by eq. (17) as printed; each step is F, Q, the stacked H and its R^-1 weights."""
    information = np.linalg.inv(prior)
    for f, q, h, weights in steps:
        information = np.linalg.inv(q + f @ np.linalg.inv(information) @ f.T)
        information = information + h.T @ (weights[:, None] * h)
    return np.linalg.inv(information)


@pytest.mark.parametrize("seed", range(5))
def test_the_recursion_against_explicit_inverses(seed: int) -> None:
    rng = np.random.default_rng(seed)
    bs = np.array([0.0, 0.0, 40.0])
    positions = np.array([[0.0, 0.0, 40.0], [200.0, 20.0, 40.0], [60.0, 50.0, 10.0]])
    types = np.array([0, 1, 2])
    ids = np.array([7, 3, 5])
    std = rng.uniform(0.05, 0.3, DIM)
    rate = np.array([0.08, 0.08, 2e-6, 0.08])
    prior = np.diag([0.09, 0.09, 1e-4, 0.09])
    # A start that all landmarks share, so that every matrix of the witness can be inverted.
    root = rng.normal(size=(10, 10))
    joint = root @ root.T / 10.0 + np.eye(10)
    joint[:4, :4] = prior + 0.01 * np.eye(4)
    joint[:4, 4:] *= 0.01
    joint[4:, :4] *= 0.01
    bound = BoundState(joint, np.array([3, 5]), np.array([4, 7, 10]))
    state, control = np.array([70.0, 0.0, 1.5, 300.0]), Control(20.0, 0.3)
    steps = []
    for k in range(5):
        f, q = np.eye(10), np.zeros((10, 10))
        f[:4, :4] = motion_jacobian(state, control, 0.5)
        q[:4, :4] = np.diag(rate) * 0.5
        bound = predict_bound(bound, state, [ControlSpan(control, 0.5)], rate)
        state = state + rng.normal(0.0, 1.0, 4) * [5.0, 5.0, 0.1, 0.0]
        paths = observe(state, control.speed, positions, types, bs)
        seen = np.array([1.0, k % 2, 0.6])
        bound = update_bound(bound, paths, ids, types, seen, np.diag(std**2), ALL)
        h = np.zeros((3, DIM, 10))
        h[:, :, :4] = paths.ue_jacobian
        h[1, :, 4:7], h[2, :, 7:10] = paths.landmark_jacobian[1:]
        steps.append((f, q, h.reshape(-1, 10), np.repeat(seen, DIM) * np.tile(std**-2.0, 3)))
    expected = dense(joint, steps)
    np.testing.assert_allclose(bound.covariance, expected, rtol=1e-7, atol=1e-10)
    bounds = bounds_of(bound, np.array([5, 3]))
    variance = np.diag(expected)
    assert bounds.peb == pytest.approx(math.sqrt(variance[:2].sum()))
    assert bounds.heb == pytest.approx(math.sqrt(variance[2]))
    assert bounds.ceb == pytest.approx(math.sqrt(variance[3]))
    np.testing.assert_allclose(bounds.leb**2, [variance[7:].sum(), variance[4:7].sum()])


def test_a_full_covariance_per_path_counts() -> None:
    rng = np.random.default_rng(4)
    positions, types = np.array([[0.0, 0.0, 40.0], [0.0, 0.0, 40.0]]), np.array([0, 0])
    state = np.array([70.0, 0.0, 1.5, 300.0])
    paths = observe(state, 20.0, positions, types, positions[0])
    root = rng.normal(size=(2, DIM, DIM))
    noise = root @ np.swapaxes(root, 1, 2) + np.eye(DIM)
    used = np.array([True, True, False, True, False, True])
    prior = np.diag([0.09, 0.09, 1e-3, 0.09])
    bound = update_bound(
        initial_bound(prior), paths, np.array([0, 1]), types, np.ones(2), noise, used
    )
    information = np.linalg.inv(prior)
    for path in range(2):
        a = paths.ue_jacobian[path][used]
        information = information + a.T @ np.linalg.inv(noise[path][np.ix_(used, used)]) @ a
    np.testing.assert_allclose(bound.covariance, np.linalg.inv(information), rtol=1e-9)


def test_the_split_of_the_information_adds_up() -> None:
    scenario = load_scenario("paper")
    positions, types = all_landmarks(scenario)
    state = nominal_trajectory(scenario)[3]
    paths = observe(state, 22.22, positions, types, scenario.bs)
    split = information_split(paths, scenario)
    precision = np.linalg.inv(scenario.noise)
    a, b = paths.ue_jacobian, paths.landmark_jacobian
    whole_ue = sum(a[i].T @ precision @ a[i] for i in range(len(types)))
    whole_landmark = np.array([b[i].T @ precision @ b[i] for i in range(len(types))])
    np.testing.assert_allclose(split.ue + split.ue_doppler, whole_ue, rtol=1e-10)
    np.testing.assert_allclose(
        split.landmark + split.landmark_doppler, whole_landmark, rtol=1e-9, atol=1e-12
    )
    # Doppler: one direction per landmark, nothing about the clock; the rest is the model without.
    assert np.all(np.linalg.matrix_rank(split.landmark_doppler[1:]) <= 1)
    assert not split.ue_doppler[3].any() and split.ue_doppler[2, 2] > 0.0
    silent = information_split(paths, with_doppler_std(scenario, None))
    np.testing.assert_allclose(silent.ue, split.ue)
    assert not silent.ue_doppler.any() and not silent.landmark_doppler.any()


def test_doppler_says_nothing_about_a_path_along_the_velocity() -> None:
    scenario = replace(load_scenario("paper"), bs_position=(0.0, 0.0, 0.0))
    paths = observe(
        np.array([50.0, 0.0, math.pi, 0.0]), 20.0, np.zeros((1, 3)), np.array([0]), scenario.bs
    )
    np.testing.assert_allclose(information_split(paths, scenario).ue_doppler, 0.0, atol=1e-20)


def test_landmarks_not_seen_yet_are_infinite() -> None:
    scenario = load_scenario("paper_bounds")
    first = bounds_of(recursion(scenario, steps=1), IDS[1:])
    assert np.isfinite(first.leb).tolist() == [True] * 4 + [True] + [False] * 3
    assert first.leb[4] < 10.0
    last = bounds_of(recursion(scenario), IDS[1:])
    assert np.isfinite(last.leb).all()
    # Landmark ids that never existed are not located either.
    assert bounds_of(recursion(scenario, steps=1), np.array([99])).leb.tolist() == [math.inf]


def test_a_landmark_that_the_components_cannot_locate_is_infinite() -> None:
    scenario = load_scenario("paper_bounds")
    positions, types = all_landmarks(scenario)
    paths = observe(nominal_trajectory(scenario)[0], 22.22, positions, types, scenario.bs)
    only_length = np.arange(DIM) == 0
    bound = update_bound(
        initial_bound(scenario.initial_covariance),
        paths,
        IDS,
        types,
        np.ones(9),
        scenario.noise,
        only_length,
    )
    assert np.isinf(bounds_of(bound, IDS[1:]).leb).all()


def test_nothing_seen_is_the_prediction() -> None:
    scenario = load_scenario("paper_bounds")
    positions, types = all_landmarks(scenario)
    before = recursion(scenario, steps=3)
    paths = observe(nominal_trajectory(scenario)[3], 22.22, positions, types, scenario.bs)
    after = update_bound(before, paths, IDS, types, np.zeros(9), scenario.noise, ALL)
    np.testing.assert_array_equal(after.covariance, before.covariance)


def test_shapes_that_do_not_fit_are_refused() -> None:
    state, rate = initial_bound(np.eye(4)), np.ones(4)
    with pytest.raises(ValueError, match="'ue' has the shape"):
        predict_bound(state, np.zeros(3), [], rate)
    with pytest.raises(ValueError, match="'covariance' has the shape"):
        predict_bound(state._replace(covariance=np.zeros((5, 4))), np.zeros(4), [], rate)
    positions, types = np.zeros((1, 3)), np.array([0])
    paths = observe(np.ones(5), 1.0, positions, types, np.zeros(3))
    with pytest.raises(ValueError, match="'ue_jacobian' has the shape"):
        update_bound(state, paths, types, types, np.ones(1), np.eye(DIM), ALL)


def test_doppler_never_hurts_and_better_doppler_is_better() -> None:
    scenario = load_scenario("paper_bounds")
    for output in session_outputs(scenario):
        assert output.with_doppler.peb <= output.without_doppler.peb * (1 + 1e-9)
        assert output.with_doppler.heb <= output.without_doppler.heb * (1 + 1e-9)
        assert output.with_doppler.ceb <= output.without_doppler.ceb * (1 + 1e-9)
        known = np.isfinite(output.without_doppler.leb)
        assert np.all(output.with_doppler.leb[known] <= output.without_doppler.leb[known] * 1.0001)
    table = np.array([four(nominal_bounds(with_doppler_std(scenario, s))) for s in SIGMAS])
    assert np.all(np.diff(table, axis=0) > 0.0)


def test_the_covariance_stays_positive_definite_without_process_noise() -> None:
    scenario = load_scenario("paper_bounds")
    still = replace(
        scenario,
        process_noise_std=(0.0,) * 4,
        measurement_noise_std=(1e-4, 1e-5, 1e-5, 1e-5, 1e-5, 1e-4),
        controls=scenario.controls * 4,
    )
    bound = recursion(still)
    assert np.isfinite(bound.covariance).all()
    assert np.linalg.eigvalsh(bound.covariance)[0] > 0.0


SINGULAR = {
    "under an SP": (np.array([99.0, 0.0, 0.0, 0.0]), 22.22),
    "under the BS": (np.array([0.0, 0.0, 0.0, 0.0]), 22.22),
    "on a wall": (np.array([100.0, 7.0, 0.0, 0.0]), 22.22),
    "behind a wall": (np.array([130.0, 7.0, 0.0, 0.0]), 22.22),
    "standing": (np.array([70.0, 7.0, 0.0, 0.0]), 0.0),
}


@pytest.mark.parametrize("detected", [True, False])
@pytest.mark.parametrize("name", list(SINGULAR))
def test_singular_geometry_leaves_the_bounds_finite(name: str, detected: bool) -> None:
    state, speed = SINGULAR[name]
    scenario = load_scenario("paper_bounds")
    positions, types = all_landmarks(scenario)
    # One VA at the BS, one SP at the BS, one SP right at the vehicle.
    positions = np.vstack([positions, scenario.bs, scenario.bs, [state[0], state[1], 0.0]])
    types = np.append(types, [LandmarkType.VA, LandmarkType.SP, LandmarkType.SP])
    session = BoundsSession(bounds_parameters_for(scenario))
    outputs: list[BoundsOutput] = []
    seen = np.ones(len(types), dtype=bool) if detected else None
    for stamp in (10**9, 2 * 10**9):
        outputs += session.add_control(stamp, speed, 0.0)
        world = WorldState(state, np.arange(len(types)), types, positions, seen)
        outputs += session.add_world(stamp, world)
    assert len(outputs) == 2
    for output in outputs:
        for bounds in (output.with_doppler, output.without_doppler):
            assert np.isfinite(bounds[:3]).all() and min(bounds[:3]) > 0.0
            assert not np.isnan(bounds.leb).any()
            assert np.isinf(bounds.leb[-3:]).all()


def test_the_session_does_not_count_doppler_at_an_unknown_speed() -> None:
    scenario = load_scenario("paper_bounds")
    positions, types = all_landmarks(scenario)
    session = BoundsSession(bounds_parameters_for(scenario))
    world = WorldState(nominal_trajectory(scenario)[0], IDS, types, positions)
    assert list(session.add_world(10**9, world)) == []
    (output,) = session.end()
    assert session.problems["missing_control"] == 1
    assert output.with_doppler[:3] == output.without_doppler[:3]


def test_the_session_takes_the_bs_once_listed_or_not() -> None:
    scenario = load_scenario("paper_bounds")
    positions, types = all_landmarks(scenario)
    state = nominal_trajectory(scenario)[0]
    results = []
    for keep in (np.arange(9), np.arange(1, 9)):
        session = BoundsSession(bounds_parameters_for(scenario))
        list(session.add_control(10**9, 22.22, 0.3))
        world = WorldState(state, IDS[keep], types[keep], positions[keep])
        (output,) = session.add_world(10**9, world)
        results.append(output)
    assert results[0].ids.tolist() == results[1].ids.tolist() == list(range(1, 9))
    assert results[0].with_doppler[:3] == results[1].with_doppler[:3]


def test_expected_detections_lie_between_none_and_all() -> None:
    scenario = replace(load_scenario("paper_bounds"), detection_probability=0.5)
    half = nominal_bounds(scenario)
    full = nominal_bounds(replace(scenario, detection_probability=1.0))
    assert full.peb < half.peb < 2.0 * full.peb


def test_what_is_blocked_gives_no_information() -> None:
    scenario = replace(load_scenario("paper"), detection_probability=0.7)
    everything = tuple(Blockage(source, 0.0, 1e3) for source in range(9))
    blind = nominal_bounds(replace(scenario, blocked=everything))
    # Dead reckoning, step by step.
    state, covariance = np.array(scenario.initial_state), scenario.initial_covariance
    for control in scenario.controls[:-1]:
        f = motion_jacobian(state, control, scenario.period)
        covariance = f @ covariance @ f.T + np.diag(scenario.noise_rate) * scenario.period
        state = propagate(state, control, scenario.period)
    assert blind.peb == pytest.approx(math.sqrt(covariance[0, 0] + covariance[1, 1]))
    assert blind.heb == pytest.approx(math.sqrt(covariance[2, 2]))
    assert blind.ceb == pytest.approx(math.sqrt(covariance[3, 3]))
    assert np.isinf(blind.leb).all()
    # Without one VA all is as if it were not there, but for its own bound.
    one = nominal_bounds(replace(scenario, blocked=(Blockage(2, 0.0, 1e3),)))
    rest = np.arange(8) != 1
    without = nominal_bounds(
        replace(
            scenario,
            landmarks=scenario.landmarks[rest],
            landmark_types=scenario.landmark_types[rest],
        )
    )
    np.testing.assert_allclose(one[:3], without[:3], rtol=1e-9)
    np.testing.assert_allclose(one.leb[rest], without.leb, rtol=1e-9)
    assert np.isinf(one.leb[1])


def test_a_blocked_bs_costs_while_it_lasts_and_is_made_up_for_after() -> None:
    scenario = load_scenario("paper")
    hidden = replace(scenario, blocked=(Blockage(0, 5.0, 15.0),))
    free, less = (
        np.array([output.with_doppler.peb for output in session_outputs(scene)])
        for scene in (scenario, hidden)
    )
    np.testing.assert_array_equal(free[:10], less[:10])
    assert np.all(less[10:30] > 1.02 * free[10:30])
    assert less[30] < less[29] and less[-1] < 1.1 * free[-1]
