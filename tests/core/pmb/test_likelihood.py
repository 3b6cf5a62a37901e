"""Local likelihoods: scipy's multivariate normal over what was measured as the witness."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2, multivariate_normal

from dopslam_ros.core.linalg.arrays import FloatArray
from dopslam_ros.core.linalg.jit import from_python
from dopslam_ros.core.models.channel import observe, residual
from dopslam_ros.core.models.measurements import MeasurementSet
from dopslam_ros.core.pmb import Density, FilterParameters, initial_density
from dopslam_ros.core.pmb import hypotheses as hypotheses_kernels
from dopslam_ros.core.pmb import likelihood as kernels
from dopslam_ros.core.pmb.birth import Births
from dopslam_ros.core.pmb.coordinates import frames, local_coordinates, positions
from dopslam_ros.core.pmb.coordinates_kernels import components_in_space
from dopslam_ros.core.pmb.hypotheses import LocalWeights
from dopslam_ros.core.pmb.likelihood import Likelihoods, Observed
from dopslam_ros.core.pmb.observed import prepare
from dopslam_ros.core.settings.layout import DIM
from dopslam_ros.lab.baselines.births import propose
from dopslam_ros.lab.baselines.gaussian import gaussian_terms

_local_likelihoods = from_python(kernels.local_likelihoods)
_local_weights = from_python(hypotheses_kernels.local_weights)

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


def local_likelihoods(
    state: Density, observed: Observed, speed: float, parameters: FilterParameters
) -> Likelihoods:
    """The local likelihoods that a step has."""
    fit, definite = _local_likelihoods(state, observed, speed, parameters.constants)
    assert definite
    return fit


def local_weights(
    state: Density,
    observed: Observed,
    fit: Likelihoods,
    births: Births,
    parameters: FilterParameters,
) -> LocalWeights:
    """The local weights that a step has."""
    return _local_weights(state, observed, fit, births, parameters.constants)


def two_track_state(seed: int = 0) -> Density:
    """A VA-or-SP track and an SP track; everything correlated with everything."""
    rng = np.random.default_rng(seed)
    ue = np.array([70.0, 1.0, 1.5, 300.0])
    position = np.array([[200.0, 3.0, 38.0], [98.0, 2.0, 12.0], [90.0, -25.0, 8.0]])
    origin = np.array([[60.0, 0.0, 0.0], [65.0, -2.0, 0.0], [72.0, 5.0, 0.0]])
    axes = frames(position - origin + rng.normal(0.0, 5.0, (3, 3)))
    root = rng.normal(size=(13, 13))
    correlation = root @ root.T + 13.0 * np.eye(13)
    scale = np.sqrt(np.diag(correlation))
    std = np.array([0.3, 0.3, 0.01, 0.3, 2.0, 0.02, 0.02, *[1.0, 0.03, 0.03] * 2])
    covariance = correlation / np.outer(scale, scale) * np.outer(std, std)
    return initial_density(PARAMETERS).but(
        mean=np.concatenate([ue, local_coordinates(origin, axes, position).ravel()]),
        covariance=covariance,
        origin=origin,
        axes=axes,
        component_track=np.array([0, 0, 1]),
        component_type=np.array([1, 2, 2]),
        component_weight=np.array([0.7, 0.3, 1.0]),
        track_id=np.array([1, 4]),
        existence=np.array([0.8, 0.95]),
        next_id=5,
    )


def h(state: Density, mean: FloatArray) -> FloatArray:
    """(C + 1, 6) what would be heard if the joint vector were ``mean``."""
    moved = state.but(mean=mean)
    places = np.vstack([PARAMETERS.bs, components_in_space(moved)[0]])
    types = np.concatenate([[0], state.component_type])
    return observe(moved.ue_mean, SPEED, places, types, PARAMETERS.bs).mean


def sources_of(state: Density) -> tuple[FloatArray, FloatArray]:
    """(C + 1, 6) h and (C + 1, 6, n) its whole Jacobian by differences."""
    step = 1e-6
    rows = [
        residual(h(state, state.mean + offset), h(state, state.mean - offset)) / (2.0 * step)
        for offset in step * np.eye(len(state.mean))
    ]
    return h(state, state.mean), np.stack(rows, axis=2)


def paths_near(state: Density, masks: list[list[bool]], seed: int) -> MeasurementSet:
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
    state: Density, measurements: MeasurementSet, source: int, path: int
) -> tuple[float, float]:
    """ln N(z; h, S) and the squared distance over the components that were measured."""
    mean, rows = sources_of(state)
    z = measurements.values[path]
    has = np.isfinite(z)
    given = measurements.covariances[path]
    noise = given if given.any() else PARAMETERS.noise
    s = rows[source] @ state.covariance @ rows[source].T + noise
    s = s[np.ix_(has, has)]
    difference = residual(z, mean[source])[has]
    log_density = multivariate_normal(np.zeros(has.sum()), s).logpdf(difference)
    return float(log_density), float(difference @ np.linalg.inv(s) @ difference)


@pytest.mark.parametrize("seed", range(4))
def test_likelihoods_are_densities_of_what_was_measured(seed: int) -> None:
    state = two_track_state(seed)
    measurements = paths_near(state, MASKS, seed)
    fit = local_likelihoods(state, prepare(measurements, PARAMETERS), SPEED, PARAMETERS)
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


@pytest.mark.parametrize("seed", range(3))
def test_jacobians_are_those_of_the_joint_vector(seed: int) -> None:
    state = two_track_state(seed)
    fit = local_likelihoods(
        state, prepare(paths_near(state, MASKS, 0), PARAMETERS), SPEED, PARAMETERS
    )
    _, rows = sources_of(state)
    np.testing.assert_allclose(fit.ue_jacobian, rows[:, :, :4], atol=2e-6)
    for source in range(1, 4):
        block = rows[source, :, 1 + 3 * source : 4 + 3 * source]
        np.testing.assert_allclose(fit.landmark_jacobian[source], block, atol=2e-5)


def test_a_young_landmark_foresees_its_next_path() -> None:
    """0.1 m along the ray and 8 m across: the innovation's covariance holds for samples of it."""
    state = two_track_state()
    q = state.mean[4:].reshape(-1, 3)
    std = np.concatenate([[0.3, 0.3, 0.005, 0.3], *([0.1, 8.0 / r, 8.0 / r] for r in q[:, 0])])
    state = state.but(covariance=np.diag(std**2))
    fit = local_likelihoods(
        state, prepare(paths_near(state, MASKS, 0), PARAMETERS), SPEED, PARAMETERS
    )
    drawn = np.random.default_rng(0).multivariate_normal(state.mean, state.covariance, 4000)
    lengths = np.array([h(state, mean)[1, 0] for mean in drawn])  # of the VA
    row = np.concatenate([fit.ue_jacobian[1, 0], fit.landmark_jacobian[1, 0]])
    variance = row @ state.covariance[:7, :7] @ row
    assert lengths.var() == pytest.approx(variance, rel=0.1)
    assert lengths.mean() == pytest.approx(h(state, state.mean)[1, 0], abs=0.05)


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
    fit = local_likelihoods(state, observed, SPEED, PARAMETERS)
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
    fit = local_likelihoods(
        state, prepare(paths_near(state, MASKS, 0), PARAMETERS), SPEED, PARAMETERS
    )
    assert fit.detection[:2].tolist() == [0.9, 0.9]  # BS and VA
    # The SP is 30 m away. Sampling tells how often one drawn at the edge is inside.
    assert fit.detection[2] == pytest.approx(0.9, abs=1e-6)
    edge = with_sp_at(state, [70.0 + 49.0, 1.0, 5.0])
    p_d = local_likelihoods(
        edge, prepare(paths_near(edge, MASKS, 0), PARAMETERS), SPEED, PARAMETERS
    )
    inside = share_inside(edge, 20_000)
    assert 0.2 < inside < 0.95
    assert p_d.detection[2] == pytest.approx(0.9 * inside, abs=0.02)


@pytest.mark.parametrize("correlation", [-0.9, 0.0, 0.9])
def test_what_vehicle_and_sp_have_in_common_does_not_blur_the_edge(correlation: float) -> None:
    state = with_sp_at(two_track_state(), [70.0 + 48.5, 1.0, 0.0])
    covariance = np.diag(np.diag(state.covariance))
    covariance[[0, 7], [0, 7]] = 9.0  # both 3 m unsure along the line between them
    covariance[0, 7] = covariance[7, 0] = 9.0 * correlation
    state = state.but(covariance=covariance)
    fit = local_likelihoods(
        state, prepare(paths_near(state, MASKS, 0), PARAMETERS), SPEED, PARAMETERS
    )
    assert fit.detection[2] == pytest.approx(0.9 * share_inside(state, 40_000), abs=0.02)


def with_sp_at(state: Density, position: list[float]) -> Density:
    """The first SP component moved, its frame pointing there."""
    place, origin, axes = np.array([position]), state.origin[1:2], state.axes.copy()
    axes[1] = frames(place - origin)[0]
    mean = state.mean.copy()
    mean[7:10] = local_coordinates(origin, axes[1:2], place)[0]
    return state.but(mean=mean, axes=axes)


def share_inside(state: Density, count: int) -> float:
    """How often the first SP component is in the field of view, by sampling."""
    drawn = np.random.default_rng(0).multivariate_normal(state.mean, state.covariance, count)
    repeated = [np.repeat(part[1:2], count, axis=0) for part in (state.origin, state.axes)]
    offset = positions(*repeated, drawn[:, 7:10])
    offset[:, :2] -= drawn[:, :2]
    return float(np.mean(np.linalg.norm(offset, axis=1) <= 50.0))


def test_the_gate_drops_what_is_far() -> None:
    parameters = replace(PARAMETERS, gate_probability=0.99)
    state = two_track_state()
    mean, _ = sources_of(state)
    values = mean[[0, 0]].copy()
    values[1, 0] += 30.0
    measurements = MeasurementSet(values, np.zeros((2, DIM, DIM)))
    fit = local_likelihoods(state, prepare(measurements, parameters), SPEED, parameters)
    assert np.isfinite(fit.log_likelihood[0, 0]) and fit.log_likelihood[0, 1] == -np.inf


def test_azimuth_innovations_wrap() -> None:
    state = two_track_state()
    mean, _ = sources_of(state)
    values = mean[[0]].copy()
    values[0, [1, 3]] += 2.0 * math.pi + 0.01
    measurements = MeasurementSet(values, np.zeros((1, DIM, DIM)))
    fit = local_likelihoods(state, prepare(measurements, PARAMETERS), SPEED, PARAMETERS)
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
    fit = local_likelihoods(state, observed, SPEED, parameters)
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
