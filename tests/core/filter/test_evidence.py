"""Local likelihoods: scipy's multivariate normal over what was measured as the witness."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2, multivariate_normal

from dopslam_ros.core.arrays import FloatArray
from dopslam_ros.core.channel import DIM, observe, residual
from dopslam_ros.core.filter import FilterParameters, FilterState, initial_filter_state
from dopslam_ros.core.filter.birth import Births, propose
from dopslam_ros.core.filter.evidence import gaussian_terms, prepare, weigh
from dopslam_ros.core.filter.hypotheses import local_weights
from dopslam_ros.core.measurements import MeasurementSet

PARAMETERS = FilterParameters(gate_probability=1.0 - 1e-12)
SPEED = 22.22
MASKS = [
    [True] * 6,
    [True, True, True, True, True, False],
    [True, True, False, True, False, True],
    [True, True, True, False, False, True],
    [False, True, True, True, True, True],
    [True, False, False, True, True, False],
    [False, False, False, False, False, True],
]


def two_track_state(seed: int = 0) -> FilterState:
    """A VA-or-SP track and an SP track; everything correlated with everything."""
    rng = np.random.default_rng(seed)
    mean = np.array([70.0, 1.0, 1.5, 300.0, 200.0, 3.0, 38.0, 98.0, 2.0, 12.0, 90.0, -25.0, 8.0])
    root = rng.normal(size=(13, 13))
    correlation = root @ root.T + 13.0 * np.eye(13)
    scale = np.sqrt(np.diag(correlation))
    std = np.array([0.3, 0.3, 0.01, 0.3, *[2.0] * 3, *[1.0] * 6])
    covariance = correlation / np.outer(scale, scale) * np.outer(std, std)
    return replace(
        initial_filter_state(PARAMETERS),
        mean=mean,
        covariance=covariance,
        component_track=np.array([0, 0, 1]),
        component_type=np.array([1, 2, 2]),
        component_weight=np.array([0.7, 0.3, 1.0]),
        track_id=np.array([1, 4]),
        existence=np.array([0.8, 0.95]),
        next_id=5,
    )


def sources_of(state: FilterState) -> tuple[FloatArray, FloatArray]:
    """(C + 1, 6) h and (C + 1, 6, n) its whole Jacobian."""
    positions = np.vstack([PARAMETERS.bs, state.positions])
    types = np.concatenate([[0], state.component_type])
    paths = observe(state.ue_mean, SPEED, positions, types, PARAMETERS.bs)
    rows = np.zeros((len(types), DIM, len(state.mean)))
    rows[:, :, :4] = paths.ue_jacobian
    for source in range(1, len(types)):
        rows[source, :, 1 + 3 * source : 4 + 3 * source] = paths.landmark_jacobian[source]
    return paths.mean, rows


def path_length(state: FloatArray, source: int, types: list[int]) -> float:
    """Of a source, without the clock, from the whole state vector."""
    ue, bs = np.array([state[0], state[1], 0.0]), PARAMETERS.bs
    if source == 0:
        return float(np.linalg.norm(bs - ue))
    x = state[1 + 3 * source : 4 + 3 * source]
    leg = np.linalg.norm(x - bs) if types[source - 1] == 2 else 0.0
    return float(np.linalg.norm(x - ue) + leg)


def length_hessian(state: FilterState, source: int) -> FloatArray:
    """Second derivatives of the path length by the whole state vector, by differences."""
    n, step = len(state.mean), 0.01
    types = state.component_type.tolist()
    hessian = np.zeros((n, n))
    active = [0, 1, *range(1 + 3 * source, 4 + 3 * source)] if source else [0, 1]
    offsets = step * np.eye(n)
    for i in active:
        for j in active:
            corners = [
                sign
                * other
                * path_length(state.mean + sign * offsets[i] + other * offsets[j], source, types)
                for sign in (1, -1)
                for other in (1, -1)
            ]
            hessian[i, j] = sum(corners) / (4.0 * step**2)
    return hessian


def paths_near(state: FilterState, masks: list[list[bool]], seed: int) -> MeasurementSet:
    """A path near a source for each mask, sources in turn; a covariance of its own for some."""
    rng = np.random.default_rng(seed)
    mean, _ = sources_of(state)
    values = mean[np.arange(len(masks)) % len(mean)].copy()
    values += rng.normal(0.0, [0.1, 0.05, 0.05, 0.05, 0.05, 0.1], values.shape)
    values = np.where(np.array(masks), values, np.nan)
    covariances = np.zeros((len(masks), DIM, DIM))
    for path in range(0, len(masks), 3):
        root = rng.normal(size=(DIM, DIM)) * 0.03
        covariances[path] = root @ root.T + 0.001 * np.eye(DIM)
    return MeasurementSet(values, covariances)


def density(
    state: FilterState, measurements: MeasurementSet, source: int, path: int
) -> tuple[float, float]:
    """ln N(z; h, S) and the squared distance over the components that were measured."""
    mean, rows = sources_of(state)
    z = measurements.values[path]
    has = np.isfinite(z)
    given = measurements.covariances[path]
    noise = given if given.any() else PARAMETERS.noise
    s = rows[source] @ state.covariance @ rows[source].T + noise
    product = length_hessian(state, source) @ state.covariance
    s[0, 0] += 0.5 * np.trace(product @ product)
    mean[source, 0] += 0.5 * np.trace(product)
    s = s[np.ix_(has, has)]
    difference = residual(z, mean[source])[has]
    log_density = multivariate_normal(np.zeros(has.sum()), s).logpdf(difference)
    return float(log_density), float(difference @ np.linalg.inv(s) @ difference)


@pytest.mark.parametrize("seed", range(4))
def test_likelihoods_are_densities_of_what_was_measured(seed: int) -> None:
    state = two_track_state(seed)
    measurements = paths_near(state, MASKS, seed)
    fit = weigh(state, prepare(measurements, PARAMETERS), SPEED, PARAMETERS)
    for source in range(4):
        for path, mask in enumerate(MASKS):
            expected, distance = density(state, measurements, source, path)
            if distance < chi2.ppf(PARAMETERS.gate_probability, sum(mask)):
                assert fit.log_likelihood[source, path] == pytest.approx(expected, rel=1e-5)
            else:
                assert fit.log_likelihood[source, path] == -np.inf
    # Each path fits the source that it was made from.
    near = np.arange(len(MASKS)) % 4
    assert np.isfinite(fit.log_likelihood[near, np.arange(len(MASKS))]).all()


SOURCES = {"BS": 0, "VA": 1, "SP": 2}


@pytest.mark.parametrize("name", list(SOURCES))
def test_curvature_of_the_path_length_against_the_hessian(name: str) -> None:
    state, source = two_track_state(1), SOURCES[name]
    fit = weigh(state, prepare(paths_near(state, MASKS, 0), PARAMETERS), SPEED, PARAMETERS)
    product = length_hessian(state, source) @ state.covariance
    expected = 0.5 * np.trace(product @ product)
    assert fit.curvature[source] == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("name", list(SOURCES))
def test_moments_of_the_path_length_of_a_young_landmark_against_sampling(name: str) -> None:
    # Known to 0.1 m along the ray and to 4 m across it.
    source, state = SOURCES[name], two_track_state()
    covariance = np.diag(np.square([0.3, 0.3, 0.005, 0.3, *[4.0] * 9]))
    for component in range(3):
        block = slice(4 + 3 * component, 7 + 3 * component)
        ray = state.mean[block] - [state.mean[0], state.mean[1], 0.0]
        if state.component_type[component] == 2:
            ray = ray / np.linalg.norm(ray) + unit(state.mean[block] - PARAMETERS.bs)
        along = np.outer(unit(ray), unit(ray))
        covariance[block, block] = 0.01 * along + 16.0 * (np.eye(3) - along)
    state = replace(state, covariance=covariance)
    measurements = MeasurementSet(np.full((1, DIM), 1.0), np.zeros((1, DIM, DIM)))
    fit = weigh(state, prepare(measurements, PARAMETERS), SPEED, PARAMETERS)
    _, rows = sources_of(state)
    variance = rows[source, 0] @ covariance @ rows[source, 0] + fit.curvature[source]
    mean = 1.0 - fit.innovation[source, 0, 0]
    drawn = np.random.default_rng(0).multivariate_normal(state.mean, covariance, 20_000)
    types = state.component_type.tolist()
    lengths = np.array([path_length(s, source, types) + s[3] for s in drawn])
    assert mean == pytest.approx(lengths.mean(), abs=5.0 * lengths.std() / math.sqrt(20_000))
    assert variance == pytest.approx(lengths.var(), rel=0.06)


def unit(vector: FloatArray) -> FloatArray:
    return np.asarray(vector / np.linalg.norm(vector))


def no_births(count: int, log_intensity: float = -np.inf) -> Births:
    return Births(
        np.zeros((2, count, 3)),
        np.tile(np.eye(3), (2, count, 1, 1)),
        np.zeros((2, count, 3, 4)),
        np.full((2, count), log_intensity),
    )


@pytest.mark.parametrize("seed", range(3))
def test_local_weights_against_direct_evaluation(seed: int) -> None:
    state = two_track_state(seed)
    measurements = paths_near(state, MASKS, seed)
    observed = prepare(measurements, PARAMETERS)
    fit = weigh(state, observed, SPEED, PARAMETERS)
    weights = local_weights(state, observed, fit, no_births(len(MASKS), -5.0), PARAMETERS)
    r, u = [1.0, 0.8, 0.95], [[1.0], [0.7, 0.3], [1.0]]
    sources = [[0], [1, 2], [3]]
    p_d = fit.detection
    for row in range(3):
        q = sum(w * (1.0 - p_d[s]) for w, s in zip(u[row], sources[row], strict=True))
        assert math.exp(weights.missed[row]) == pytest.approx(1.0 - r[row] + r[row] * q)
        for path in range(len(MASKS)):
            parts = [
                r[row] * w * p_d[s] * math.exp(density(state, measurements, s, path)[0])
                if np.isfinite(fit.log_likelihood[s, path])
                else 0.0
                for w, s in zip(u[row], sources[row], strict=True)
            ]
            assert np.exp(weights.track[row, path]) == pytest.approx(sum(parts), rel=1e-4)
            for part, s in zip(parts, sources[row], strict=True):
                assert np.exp(weights.source[s, path]) == pytest.approx(part, rel=1e-4)
    # c of what was measured, uniform over 400 m, full and half circles, 50 m/s; and two births.
    spans = np.array([400.0, 2 * math.pi, math.pi, 2 * math.pi, math.pi, 50.0])
    for path, mask in enumerate(MASKS):
        c = 1.0 / np.prod(spans[mask])
        assert math.exp(weights.new[path]) == pytest.approx(c + 2.0 * math.exp(-5.0))


def test_detection_probabilities_of_sps_fade_at_the_edge_of_the_field_of_view() -> None:
    state = two_track_state()
    fit = weigh(state, prepare(paths_near(state, MASKS, 0), PARAMETERS), SPEED, PARAMETERS)
    assert fit.detection[:2].tolist() == [0.9, 0.9]  # BS and VA
    # The SP is 30 m away. Sampling tells how often one drawn at the edge is inside.
    assert fit.detection[2] == pytest.approx(0.9, abs=1e-6)
    edge = replace(state, mean=state.mean.copy())
    edge.mean[7:10] = [70.0 + 49.0, 1.0, 5.0]
    p_d = weigh(edge, prepare(paths_near(edge, MASKS, 0), PARAMETERS), SPEED, PARAMETERS)
    drawn = np.random.default_rng(0).multivariate_normal(edge.mean, edge.covariance, 20_000)
    offset = drawn[:, 7:10] - np.column_stack([drawn[:, :2], np.zeros(len(drawn))])
    inside = np.mean(np.linalg.norm(offset, axis=1) <= 50.0)
    assert 0.2 < inside < 0.95
    assert p_d.detection[2] == pytest.approx(0.9 * inside, abs=0.02)


@pytest.mark.parametrize("correlation", [-0.9, 0.0, 0.9])
def test_what_vehicle_and_sp_have_in_common_does_not_blur_the_edge(correlation: float) -> None:
    state = two_track_state()
    covariance = np.diag(np.diag(state.covariance))
    covariance[[0, 7], [0, 7]] = 9.0  # both 3 m unsure along the line between them
    covariance[0, 7] = covariance[7, 0] = 9.0 * correlation
    mean = state.mean.copy()
    mean[7:10] = [70.0 + 48.5, 1.0, 0.0]
    state = replace(state, mean=mean, covariance=covariance)
    fit = weigh(state, prepare(paths_near(state, MASKS, 0), PARAMETERS), SPEED, PARAMETERS)
    drawn = np.random.default_rng(0).multivariate_normal(mean, covariance, 40_000)
    offset = drawn[:, 7:10] - np.column_stack([drawn[:, :2], np.zeros(len(drawn))])
    inside = np.mean(np.linalg.norm(offset, axis=1) <= 50.0)
    assert fit.detection[2] == pytest.approx(0.9 * inside, abs=0.02)


def test_the_gate_drops_what_is_far() -> None:
    parameters = replace(PARAMETERS, gate_probability=0.99)
    state = two_track_state()
    mean, _ = sources_of(state)
    values = mean[[0, 0]].copy()
    values[1, 0] += 30.0
    measurements = MeasurementSet(values, np.zeros((2, DIM, DIM)))
    fit = weigh(state, prepare(measurements, parameters), SPEED, parameters)
    assert np.isfinite(fit.log_likelihood[0, 0]) and fit.log_likelihood[0, 1] == -np.inf


def test_azimuth_innovations_wrap() -> None:
    state = two_track_state()
    mean, _ = sources_of(state)
    values = mean[[0]].copy()
    values[0, [1, 3]] += 2.0 * math.pi + 0.01
    measurements = MeasurementSet(values, np.zeros((1, DIM, DIM)))
    fit = weigh(state, prepare(measurements, PARAMETERS), SPEED, PARAMETERS)
    expected = [0.01, 0.0, 0.01, 0.0, 0.0]
    np.testing.assert_allclose(fit.innovation[0, 0, 1:], expected, atol=1e-9)


def test_prepare_masks_and_fills_in() -> None:
    nan = math.nan
    values = np.array([[1.0, nan, 2.0, 3.0, nan, 4.0], [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]])
    covariances = np.zeros((2, DIM, DIM))
    covariances[1] = 2.0 * np.eye(DIM) + 0.1
    parameters = FilterParameters(measurement_noise_std=(0.1, 0.05, 0.05, 0.05, 0.05, nan))
    observed = prepare(MeasurementSet(values, covariances), parameters)
    assert observed.used.tolist() == [[1, 0, 1, 1, 0, 0], [1, 1, 1, 1, 1, 0]]
    np.testing.assert_allclose(np.diag(observed.noise[0]), [0.01, 1, 0.0025, 0.0025, 1, 1])
    expected = covariances[1].copy()
    expected[5], expected[:, 5], expected[5, 5] = 0.0, 0.0, 1.0
    np.testing.assert_array_equal(observed.noise[1], expected)
    assert np.isnan(observed.values[0]).tolist() == [False, True, False, False, True, True]


def test_a_path_with_nothing_that_is_used_is_clutter() -> None:
    parameters = FilterParameters(measurement_noise_std=(0.1, 0.05, 0.05, 0.05, 0.05, math.nan))
    values = np.full((1, DIM), math.nan)
    values[0, 5] = 3.0
    state = two_track_state()
    observed = prepare(MeasurementSet(values, np.zeros((1, DIM, DIM))), parameters)
    fit = weigh(state, observed, SPEED, parameters)
    assert (fit.log_likelihood == -np.inf).all()
    births = propose(state, observed, SPEED, parameters)
    assert (births.log_intensity == -np.inf).all()


def test_gaussian_terms_against_explicit_inverse() -> None:
    rng = np.random.default_rng(0)
    root = rng.normal(size=(3, 2, 5, 5))
    covariance = root @ np.swapaxes(root, -1, -2) + np.eye(5)
    vector = rng.normal(size=(3, 2, 5))
    distance, log_determinant = gaussian_terms(covariance, vector)
    expected = np.einsum("abi,abij,abj->ab", vector, np.linalg.inv(covariance), vector)
    np.testing.assert_allclose(distance, expected)
    np.testing.assert_allclose(np.exp(log_determinant), np.linalg.det(covariance))
