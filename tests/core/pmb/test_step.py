"""A whole step: a plain EKF as the witness, and what must hold whatever comes in."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag

from dopslam_ros.core.linalg.arrays import FloatArray, wrap_angle
from dopslam_ros.core.models.channel import observe
from dopslam_ros.core.models.measurements import MeasurementSet
from dopslam_ros.core.models.motion import Control, ControlSpan
from dopslam_ros.core.pmb import (
    Density,
    FilterParameters,
    Posterior,
    initial_density,
    initial_posterior,
    prepare,
    reported_landmarks,
    step,
)
from dopslam_ros.core.pmb.coordinates import frames, local_coordinates
from dopslam_ros.core.pmb.coordinates_kernels import components_in_space
from dopslam_ros.core.pmb.inactive_grid import InactiveGrid
from dopslam_ros.core.pmb.posterior import posterior_of
from dopslam_ros.core.pmb.step import predict
from dopslam_ros.core.settings.layout import DIM, NONE, LandmarkType
from dopslam_ros.simulation.matched import filter_parameters_for
from dopslam_ros.simulation.scenario import load_scenario
from dopslam_ros.simulation.simulator import simulate

SPEED, TURN, PERIOD = 22.22, math.pi / 10.0, 0.5
SPAN = ControlSpan(Control(SPEED, TURN), PERIOD)


def set_of(values: FloatArray) -> MeasurementSet:
    return MeasurementSet(values, np.zeros((len(values), DIM, DIM)))


def empty_set() -> MeasurementSet:
    return set_of(np.zeros((0, DIM)))


def with_map(parameters: FilterParameters, positions: FloatArray, types: list[int]) -> Density:
    """A sure landmark at each position, 0.5 m well known."""
    count = len(types)
    start = initial_density(parameters)
    origin = np.tile([60.0, -3.0, 0.0], (count, 1))
    axes = frames(positions - origin)
    q = local_coordinates(origin, axes, positions)
    std = 0.5 / np.stack([np.ones(count), q[:, 0], q[:, 0]], axis=1)
    return start.but(
        mean=np.concatenate([start.mean, q.ravel()]),
        covariance=block_diag(start.covariance, np.diag(std.ravel() ** 2)),
        origin=origin,
        axes=axes,
        component_track=np.arange(count),
        component_type=np.array(types, dtype=np.int64),
        component_weight=np.ones(count),
        track_id=np.arange(1, count + 1),
        existence=np.full(count, 0.99),
        next_id=count + 1,
    )


def alone(density: Density) -> Posterior:
    """The posterior that has no other hypothesis, and nothing out of view."""
    return posterior_of(density, InactiveGrid())


class HandWrittenEkf:
    """The vehicle and the BS alone: eqs. (1) and (4) to (11), the Jacobian by differences."""

    def __init__(self, parameters: FilterParameters) -> None:
        self.mean = np.array(parameters.initial_state)
        self.covariance = np.diag(np.square(parameters.initial_std))
        self.q = np.diag(np.square(parameters.process_noise_std))
        self.r = np.diag(np.square(parameters.measurement_noise_std))
        self.bs = np.array(parameters.bs_position)

    def h(self, s: FloatArray) -> FloatArray:
        away = self.bs - np.array([s[0], s[1], 0.0])
        distance, ground = np.linalg.norm(away), np.hypot(away[0], away[1])
        velocity = SPEED * np.array([math.cos(s[2]), math.sin(s[2]), 0.0])
        return np.array(
            [
                distance + s[3],
                math.atan2(away[1], away[0]) - s[2],
                math.atan2(away[2], ground),
                math.atan2(-away[1], -away[0]),
                math.atan2(-away[2], ground),
                velocity @ away / distance,
            ]
        )

    @staticmethod
    def f(s: FloatArray) -> FloatArray:
        chord = 2.0 * SPEED / TURN * math.sin(TURN * PERIOD / 2.0)
        middle = s[2] + TURN * PERIOD / 2.0
        moved = [chord * math.cos(middle), chord * math.sin(middle), TURN * PERIOD, 0.0]
        return s + np.array(moved)

    def predict(self) -> None:
        jacobian = np.eye(4)
        moved = self.f(self.mean)
        jacobian[0, 2] = -(moved[1] - self.mean[1])
        jacobian[1, 2] = moved[0] - self.mean[0]
        self.mean = moved
        self.covariance = jacobian @ self.covariance @ jacobian.T + self.q

    def update(self, z: FloatArray) -> float:
        """Returns the normalised innovation squared."""
        columns = []
        for offset in 1e-4 * np.eye(4):
            difference = self.h(self.mean + offset) - self.h(self.mean - offset)
            difference[[1, 3]] = wrap_angle(difference[[1, 3]])
            columns.append(difference / 2e-4)
        jacobian = np.array(columns).T
        innovation = z - self.h(self.mean)
        innovation[[1, 3]] = wrap_angle(innovation[[1, 3]])
        s = jacobian @ self.covariance @ jacobian.T + self.r
        gain = self.covariance @ jacobian.T @ np.linalg.inv(s)
        self.mean = self.mean + gain @ innovation
        self.covariance = (np.eye(4) - gain @ jacobian) @ self.covariance
        return float(innovation @ np.linalg.inv(s) @ innovation)


@pytest.mark.parametrize("coupling", ["joint", "marginal"])
def test_with_the_bs_alone_the_filter_is_an_ekf(coupling: str) -> None:
    scenario = replace(
        load_scenario("paper"),
        landmarks=np.zeros((0, 3)),
        landmark_types=np.zeros(0, dtype=np.int64),
        clutter_mean=0.0,
        detection_probability=0.8,
    )
    # One association only, else a second one says that the path was of a new landmark.
    parameters = filter_parameters_for(scenario, gamma=1, coupling=coupling)
    state, ekf = initial_posterior(parameters), HandWrittenEkf(parameters)
    updates = 0
    for snapshot in simulate(scenario, np.random.default_rng(4)):
        spans = [SPAN] if snapshot.step else []
        state, said = step(
            state, prepare(snapshot.measurements, parameters), spans, SPEED, parameters
        )
        if snapshot.step:
            ekf.predict()
        nis = 0.0
        if len(snapshot.measurements):
            nis = ekf.update(snapshot.measurements.values[0])
            updates += 1
        assert said.nis == pytest.approx(nis, rel=1e-4)
        assert said.nis_dof == (DIM if len(snapshot.measurements) else 0)
        difference = state.ue_mean - ekf.mean
        difference[2] = wrap_angle(difference[2])
        np.testing.assert_allclose(difference, 0.0, atol=1e-6)
        np.testing.assert_allclose(state.ue_covariance, ekf.covariance, rtol=1e-5, atol=1e-9)
    assert 20 < updates < 40


def test_predict_moves_the_vehicle_and_its_correlations_only() -> None:
    parameters = FilterParameters()
    rng = np.random.default_rng(0)
    root = rng.normal(size=(10, 10))
    state = with_map(parameters, rng.normal(0.0, 50.0, (2, 3)), [1, 2])
    state = state.but(covariance=root @ root.T + np.eye(10))
    predicted = predict(alone(state), [SPAN], parameters).density
    ekf = HandWrittenEkf(parameters)
    f = np.eye(10)
    moved = ekf.f(state.ue_mean)
    f[0, 2], f[1, 2] = -(moved[1] - state.mean[1]), moved[0] - state.mean[0]
    q = np.zeros((10, 10))
    q[:4, :4] = ekf.q
    np.testing.assert_allclose(predicted.covariance, f @ state.covariance @ f.T + q, rtol=1e-10)
    difference = predicted.ue_mean - moved
    difference[2] = wrap_angle(difference[2])
    np.testing.assert_allclose(difference, 0.0, atol=1e-9)
    np.testing.assert_array_equal(predicted.mean[4:], state.mean[4:])
    start = alone(state)
    assert predict(start, [], parameters) is start


@pytest.mark.parametrize("coupling", ["joint", "marginal"])
def test_an_empty_set_is_a_prediction_and_misses(coupling: str) -> None:
    parameters = FilterParameters(coupling=coupling)
    places = np.array([[200.0, 0.0, 40.0], [128.0, 0.0, 5.0]])
    state = alone(with_map(parameters, places, [1, 2]))
    after, said = step(state, prepare(empty_set(), parameters), [SPAN], SPEED, parameters)
    predicted = predict(state, [SPAN], parameters)
    np.testing.assert_allclose(after.ue_mean, predicted.ue_mean)
    np.testing.assert_allclose(after.ue_covariance, predicted.ue_covariance)
    # The VA was missed; the SP is out of sight and loses nothing.
    expected = 0.99 * 0.1 / (0.01 + 0.99 * 0.1)
    np.testing.assert_allclose(after.density.existence, [expected, 0.99])
    assert said.ids.shape == (1, 0)
    np.testing.assert_allclose(said.weight, [1.0])


def test_an_empty_set_before_anything_is_known() -> None:
    parameters = FilterParameters()
    start, nothing = initial_posterior(parameters), prepare(empty_set(), parameters)
    after = step(start, nothing, [], SPEED, parameters)[0].density
    np.testing.assert_array_equal(after.mean, parameters.initial_state)
    np.testing.assert_allclose(after.covariance, parameters.initial_covariance)


def test_a_path_far_from_everything_becomes_a_new_landmark_with_a_new_id() -> None:
    parameters = FilterParameters()
    state = with_map(parameters, np.array([[200.0, 0.0, 40.0]]), [int(LandmarkType.VA)])
    new = np.array([[10.0, 180.0, 40.0]])
    values = observe(state.ue_mean, SPEED, new, np.array([1]), parameters.bs).mean
    observed = prepare(set_of(values), parameters)
    posterior, said = step(alone(state), observed, [], SPEED, parameters)
    after = posterior.density
    assert said.ids[0].tolist() == [NONE]
    assert said.born.tolist() == [2]
    assert after.track_id.tolist() == [1, 2] and after.next_id == 3
    born = components_in_space(after)[0][after.component_track == 1]
    assert np.linalg.norm(born[0] - new[0]) < 0.5


def test_the_order_of_the_paths_does_not_matter() -> None:
    scenario = load_scenario("paper")
    parameters = filter_parameters_for(scenario)
    rng = np.random.default_rng(3)
    one = other = initial_posterior(parameters)
    for snapshot in simulate(scenario, np.random.default_rng(12)):
        if snapshot.step == 6:
            break
        spans = [SPAN] if snapshot.step else []
        order = rng.permutation(len(snapshot.measurements))
        shuffled = set_of(snapshot.measurements.values[order])
        one = step(one, prepare(snapshot.measurements, parameters), spans, SPEED, parameters)[0]
        other = step(other, prepare(shuffled, parameters), spans, SPEED, parameters)[0]
        np.testing.assert_allclose(one.ue_mean, other.ue_mean, rtol=1e-6)
        np.testing.assert_allclose(one.ue_covariance, other.ue_covariance, rtol=1e-5, atol=1e-9)
        ours, theirs = np.sort(one.density.existence), np.sort(other.density.existence)
        np.testing.assert_allclose(ours, theirs, rtol=1e-4)


SINGULAR = {
    "vehicle under an SP": ([70.7285, 0.0, 10.0], 2),
    "vehicle under a VA": ([70.7285, 0.0, 100.0], 1),
    "vehicle at an SP": ([70.7285, 0.0, 0.0], 2),
    "vehicle on the wall": ([141.457, 0.0, 40.0], 1),
    "incidence point behind the vehicle": ([80.0, 0.0, 40.0], 1),
    "VA at the BS": ([0.0, 0.0, 40.0], 1),
    "SP at the BS": ([0.0, 0.0, 40.0], 2),
}


@pytest.mark.parametrize("coupling", ["joint", "marginal"])
@pytest.mark.parametrize("name", list(SINGULAR))
def test_singular_geometry_leaves_the_state_finite(name: str, coupling: str) -> None:
    position, kind = SINGULAR[name]
    parameters = FilterParameters(coupling=coupling)
    state = alone(with_map(parameters, np.array([position, [200.0, 0.0, 40.0]]), [kind, 1]))
    values = observe(
        state.ue_mean,
        SPEED,
        np.array([position, [200.0, 0.0, 40.0], [0.0, 0.0, 0.0]]),
        np.array([kind, 1, 0]),
        parameters.bs,
    ).mean
    for spans in ([], [SPAN]):
        state = step(state, prepare(set_of(values), parameters), spans, SPEED, parameters)[0]
        after = state.density
        assert np.isfinite(after.mean).all() and np.isfinite(after.existence).all()
        assert np.isfinite(after.component_weight).all()
        assert np.linalg.eigvalsh(after.covariance)[0] > 0.0


def test_a_vehicle_right_under_the_bs_keeps_its_state() -> None:
    parameters = FilterParameters(initial_state=(0.0, 0.0, 0.3, 300.0))
    state = initial_posterior(parameters)
    values = np.array([[340.0, 0.1, math.pi / 2, 0.2, -math.pi / 2, 0.0]])
    after = step(state, prepare(set_of(values), parameters), [], SPEED, parameters)[0].density
    assert np.isfinite(after.mean).all() and np.linalg.eigvalsh(after.covariance)[0] > 0.0


@pytest.mark.parametrize("seed", range(10))
def test_nonsense_paths_leave_the_state_finite(seed: int) -> None:
    parameters = FilterParameters()
    rng = np.random.default_rng(seed)
    places = np.array([[200.0, 0.0, 40.0], [99.0, 0.0, 10.0]])
    state = alone(with_map(parameters, places, [1, 2]))
    for _ in range(6):
        values = rng.uniform(-1.0, 1.0, (rng.integers(1, 12), DIM))
        values = values * [2000.0, math.pi, math.pi / 2, math.pi, math.pi / 2, 100.0]
        values[rng.random(values.shape) < 0.3] = np.nan
        values[:, 0] = np.where(np.isnan(values).all(axis=1), 400.0, values[:, 0])
        state = step(state, prepare(set_of(values), parameters), [SPAN], SPEED, parameters)[0]
        after = state.density
        assert np.isfinite(after.mean).all()
        assert np.linalg.eigvalsh(after.covariance)[0] > 0.0
        assert ((after.existence >= 0.0) & (after.existence <= 1.0)).all()
        totals = np.bincount(after.component_track, after.component_weight)
        np.testing.assert_allclose(totals, 1.0)


@pytest.mark.parametrize(
    "settings",
    [
        {"detection_probability": 1.0},
        {"detection_probability": 1.0, "clutter_mean": 0.0},
        {"clutter_mean": 0.0},
        {"detection_probability": 0.0},
        {"gamma": 1},
        {"prune_existence": 0.0, "prune_type": 0.0},
        {"sp_field_of_view": 0.0},
    ],
)
def test_extreme_settings_leave_the_state_finite(settings: dict[str, float]) -> None:
    scenario = load_scenario("paper")
    parameters = filter_parameters_for(scenario, **settings)
    state = initial_posterior(parameters)
    for snapshot in simulate(scenario, np.random.default_rng(8)):
        if snapshot.step == 12:
            break
        spans = [SPAN] if snapshot.step else []
        observed = prepare(snapshot.measurements, parameters)
        state, said = step(state, observed, spans, SPEED, parameters)
        after = state.density
        assert np.isfinite(after.mean).all() and np.isfinite(after.existence).all()
        assert np.linalg.eigvalsh(after.covariance)[0] > 0.0
        assert said.weight.sum() == pytest.approx(1.0)


def test_the_map_is_reported_by_existence_and_spread() -> None:
    parameters = FilterParameters()
    state = with_map(parameters, np.arange(12.0).reshape(4, 3), [1, 2, 2, 1])
    covariance = state.covariance.copy()
    covariance[7, 7] = 150.0  # the second: root of the trace is 12 m
    state = state.but(
        covariance=covariance,
        component_track=np.array([0, 1, 2, 2]),
        component_weight=np.array([1.0, 1.0, 0.4, 0.6]),
        track_id=np.array([3, 5, 9]),
        existence=np.array([0.49, 0.9, 0.9]),
    )
    shown = reported_landmarks(alone(state), parameters)
    assert shown.ids.tolist() == [9] and shown.types.tolist() == [1]
    np.testing.assert_allclose(shown.type_probabilities, [[0.0, 0.6, 0.4]])
    np.testing.assert_allclose(shown.positions, [[9.0, 10.0, 11.0]])
    everything = replace(parameters, report_existence=0.0, report_std=100.0)
    assert reported_landmarks(alone(state), everything).ids.tolist() == [3, 5, 9]
    nothing = reported_landmarks(initial_posterior(parameters), parameters)
    assert nothing.positions.shape == (0, 3) and nothing.covariances.shape == (0, 3, 3)
