"""New landmarks: sampling and numerical integration as witnesses."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal, norm

from dopslam_ros.core.linalg.arrays import FloatArray
from dopslam_ros.core.linalg.jit import from_python
from dopslam_ros.core.linalg.vec import Vec
from dopslam_ros.core.models import channel_kernels
from dopslam_ros.core.models import incidence as incidence_kernels
from dopslam_ros.core.models.channel import observe, residual
from dopslam_ros.core.models.measurements import MeasurementSet
from dopslam_ros.core.pmb import Density, FilterParameters, initial_density
from dopslam_ros.core.pmb.birth import Births
from dopslam_ros.core.pmb.observed import prepare
from dopslam_ros.core.pmb.undetected import looked_from, nothing_seen
from dopslam_ros.core.settings.layout import DIM, UNKNOWN_TYPES
from dopslam_ros.lab.baselines.births import propose

incidence_points = from_python(incidence_kernels.measured_incidence_points)
vehicle_of = from_python(channel_kernels.vehicle_of)

SPEED = 22.22
# A weak enough prior on the height that it does not move a landmark whose elevation is measured.
PARAMETERS = FilterParameters(landmark_height_std=1000.0)
STATE = initial_density(PARAMETERS)
VA = np.array([200.0, 30.0, 45.0])
SP = np.array([95.0, 20.0, 10.0])
CASES = {"VA": (0, VA), "SP": (1, SP)}
NAMES = {
    "path_length": 0,
    "aoa_azimuth": 1,
    "aoa_elevation": 2,
    "aod_azimuth": 3,
    "aod_elevation": 4,
    "doppler": 5,
}


def h(state: FloatArray, positions: FloatArray, kind: int) -> FloatArray:
    types = np.full(len(positions), UNKNOWN_TYPES[kind])
    return observe(state, SPEED, positions, types, PARAMETERS.bs).mean


def fit(
    values: FloatArray, state: Density = STATE, parameters: FilterParameters = PARAMETERS
) -> Births:
    measurements = MeasurementSet(values, np.zeros((len(values), DIM, DIM)))
    return propose(state, prepare(measurements, parameters), SPEED, parameters)


def without(values: FloatArray, *names: str) -> FloatArray:
    less = values.copy()
    less[:, [NAMES[name] for name in names]] = np.nan
    return less


@pytest.mark.parametrize("name", list(CASES))
def test_a_path_without_noise_puts_its_landmark_where_it_is(name: str) -> None:
    kind, landmark = CASES[name]
    births = fit(h(STATE.ue_mean, landmark[None], kind))
    np.testing.assert_allclose(births.position[kind, 0], landmark, atol=0.02)
    assert np.isfinite(births.log_intensity[kind, 0])


@pytest.mark.parametrize("name", list(CASES))
@pytest.mark.parametrize(
    "missing",
    [
        ("doppler",),
        ("aod_azimuth", "aod_elevation"),
        ("aoa_azimuth", "aoa_elevation"),
        ("aoa_elevation",),
        ("aod_elevation",),
        ("path_length",),
        ("aod_azimuth",),
    ],
)
def test_a_landmark_is_located_with_components_missing(name: str, missing: tuple[str, ...]) -> None:
    kind, landmark = CASES[name]
    values = without(h(STATE.ue_mean, landmark[None], kind), *missing)
    births = fit(values)
    assert np.isfinite(births.log_intensity[kind, 0])
    error = births.position[kind, 0] - landmark
    covariance = births.covariance[kind, 0]
    assert np.linalg.eigvalsh(covariance)[0] > 0.0
    # Without noise the fit is exact, up to what the prior on the height leaves open.
    assert error @ np.linalg.solve(covariance, error) < 0.1
    full = fit(h(STATE.ue_mean, landmark[None], kind))
    assert np.trace(covariance) >= np.trace(full.covariance[kind, 0]) * (1 - 1e-6)


@pytest.mark.parametrize("name", list(CASES))
def test_without_any_elevation_the_height_comes_from_the_prior(name: str) -> None:
    kind, landmark = CASES[name]
    parameters = FilterParameters(landmark_height_mean=landmark[2], landmark_height_std=10.0)
    values = h(STATE.ue_mean, landmark[None], kind)
    births = fit(without(values, "aoa_elevation", "aod_elevation"), parameters=parameters)
    assert np.isfinite(births.log_intensity[kind, 0])
    np.testing.assert_allclose(births.position[kind, 0], landmark, atol=1.0)
    assert 3.0 < math.sqrt(births.covariance[kind, 0, 2, 2]) < 10.5


@pytest.mark.parametrize(
    "missing",
    [
        ("aoa_azimuth", "aod_azimuth"),
        ("path_length", "aod_azimuth", "aod_elevation"),
        ("path_length", "aoa_azimuth", "aoa_elevation"),
        ("path_length", "aoa_azimuth", "aod_azimuth"),
        ("path_length", "aoa_azimuth", "aoa_elevation", "aod_azimuth", "aod_elevation"),
        ("aoa_azimuth", "aoa_elevation", "aod_azimuth", "aod_elevation", "doppler"),
    ],
)
def test_what_cannot_be_located_is_refused(missing: tuple[str, ...]) -> None:
    for kind, landmark in CASES.values():
        births = fit(without(h(STATE.ue_mean, landmark[None], kind), *missing))
        assert (births.log_intensity == -np.inf).all()
        assert np.isfinite(births.position).all() and np.isfinite(births.covariance).all()


def test_a_path_shorter_than_the_direct_one_is_refused() -> None:
    values = h(STATE.ue_mean, SP[None], 1)
    values[0, 0] = STATE.ue_mean[3] + 80.0  # the BS is 81.3 m away
    assert (fit(values).log_intensity == -np.inf).all()


@pytest.mark.parametrize("seed", range(20))
def test_any_path_gives_finite_numbers(seed: int) -> None:
    rng = np.random.default_rng(seed)
    low = np.array([0.0, -math.pi, -math.pi / 2, -math.pi, -math.pi / 2, -25.0])
    high = np.array([700.0, math.pi, math.pi / 2, math.pi, math.pi / 2, 25.0])
    values = rng.uniform(low, high, (50, DIM))
    values[rng.random(values.shape) < 0.25] = np.nan
    values = values[np.isfinite(values).any(axis=1)]
    births = fit(values, parameters=FilterParameters())
    assert not np.isnan(births.log_intensity).any()
    assert (births.log_intensity < np.inf).all()
    for part in (births.position, births.covariance, births.gain):
        assert np.isfinite(part).all()
    good = np.isfinite(births.log_intensity)
    assert (np.linalg.eigvalsh(births.covariance[good])[:, 0] > 0.0).all()


@pytest.mark.parametrize("name", list(CASES))
def test_covariance_and_correlation_against_sampling(name: str) -> None:
    kind, landmark = CASES[name]
    rng = np.random.default_rng(21)
    count = 3000
    prior = np.diag([0.3, 0.3, 0.005, 0.3]) ** 2
    # A better sensor than the paper's: the fit is linear then, and sampling tells its covariance.
    std = np.array([0.1, 0.005, 0.005, 0.005, 0.005, 0.1])
    parameters = replace(PARAMETERS, measurement_noise_std=tuple(std))
    vehicles = rng.multivariate_normal(STATE.ue_mean, prior, count)
    values = np.vstack([h(vehicle, landmark[None], kind) for vehicle in vehicles])
    values = values + rng.normal(0.0, std, values.shape)
    births = fit(values, STATE.but(covariance=prior), parameters)
    assert np.isfinite(births.log_intensity[kind]).all()

    error = landmark - births.position[kind]
    distance = np.einsum("ji,jik,jk->j", error, np.linalg.inv(births.covariance[kind]), error)
    assert distance.mean() == pytest.approx(3.0, rel=0.08)
    covariance, gain = births.covariance[kind].mean(axis=0), births.gain[kind].mean(axis=0)
    joint = np.block([[prior, prior @ gain.T], [gain @ prior, covariance]])
    sampled = np.cov(np.hstack([vehicles - STATE.ue_mean, error]).T)
    scale = np.sqrt(np.outer(np.diag(joint), np.diag(joint)))
    np.testing.assert_allclose(sampled / scale, joint / scale, atol=0.1)
    assert np.abs(joint[4:, :4] / scale[4:, :4]).max() > 0.3  # there is something to see


@pytest.mark.parametrize("name", list(CASES))
def test_vehicle_and_birth_have_a_covariance_together(name: str) -> None:
    kind, landmark = CASES[name]
    births = fit(h(STATE.ue_mean, landmark[None], kind))
    p, gain = STATE.ue_covariance, births.gain[kind, 0]
    joint = np.block([[p, p @ gain.T], [gain @ p, births.covariance[kind, 0]]])
    assert np.linalg.eigvalsh(joint)[0] > 0.0


def integral(z: FloatArray, kind: int, parameters: FilterParameters) -> float:
    """Integral of lambda p_D N(z; h(x, s), R) over x and s by sampling.

    Length and angles of arrival, which must be measured, are drawn from their likelihood; they fix
    x, so what remains is the mean of the likelihood of the other components times the volume
    |dx / d(length, azimuth, elevation)|.
    """
    rng = np.random.default_rng(5)
    std = np.array(parameters.measurement_noise_std)
    rest = np.isfinite(z) & (np.arange(DIM) >= 3)
    values = []
    for vehicle in rng.multivariate_normal(STATE.ue_mean, STATE.ue_covariance, 200):
        ue = np.array([vehicle[0], vehicle[1], 0.0])
        drawn = rng.normal(z[:3], std[:3], (600, 3))
        length, azimuth, elevation = drawn[:, 0] - vehicle[3], drawn[:, 1] + vehicle[2], drawn[:, 2]
        ground = np.cos(elevation)
        ray = np.stack([ground * np.cos(azimuth), ground * np.sin(azimuth), np.sin(elevation)], 1)
        reach, slope = length, np.ones(len(length))
        if kind == 1:  # |reach ray| + |reach ray + ue - bs| = length, solved for reach
            offset = ue - parameters.bs
            below = 2.0 * (length + ray @ offset)
            reach = (length**2 - offset @ offset) / below
            slope = 2.0 * length / below - 2.0 * reach / below
        points = ue + reach[:, None] * ray
        expected = h(vehicle, points, kind)
        np.testing.assert_allclose(expected[:, 0], drawn[:, 0], atol=1e-6)
        difference = residual(z, expected)[:, rest]
        weight = np.exp(
            -0.5 * np.sum((difference / std[rest]) ** 2 + np.log(2 * np.pi * std[rest] ** 2), 1)
        )
        inside = (kind == 0) | (reach <= parameters.sp_field_of_view)
        values.append(np.mean(weight * reach**2 * ground * np.abs(slope) * inside))
    total = parameters.undetected_intensity * parameters.detection_probability
    return float(total * np.mean(values))


@pytest.mark.parametrize("missing", [(), ("doppler",), ("aod_azimuth", "aod_elevation")])
@pytest.mark.parametrize("name", list(CASES))
def test_intensity_against_numerical_integration(name: str, missing: tuple[str, ...]) -> None:
    kind, landmark = CASES[name]
    rng = np.random.default_rng(17)
    noise = rng.normal(0.0, PARAMETERS.measurement_noise_std)
    values = without(h(STATE.ue_mean, landmark[None], kind) + noise, *missing)
    births = fit(values)
    expected = integral(values[0], kind, PARAMETERS)
    assert math.exp(births.log_intensity[kind, 0]) == pytest.approx(expected, rel=0.15)


def test_intensity_at_the_edge_of_the_field_of_view_against_integration() -> None:
    edge = np.array([70.7 + 49.0, 0.0, 8.0])
    values = h(STATE.ue_mean, edge[None], 1)
    births = fit(values)
    expected = integral(values[0], 1, PARAMETERS)
    assert math.exp(births.log_intensity[1, 0]) == pytest.approx(expected, rel=0.2)
    unlimited = fit(values, parameters=replace(PARAMETERS, sp_field_of_view=1e3))
    share = math.exp(births.log_intensity[1, 0] - unlimited.log_intensity[1, 0])
    assert 0.5 < share < 0.999  # the edge is felt


def test_the_intensity_is_proportional_to_what_is_left_undetected() -> None:
    looked = looked_from(nothing_seen(), *STATE.ue_mean[:2].tolist(), PARAMETERS.sp_field_of_view)
    after = STATE.but(undetected=looked)
    for kind, place in ((0, VA), (1, SP)):  # both in view
        values = h(STATE.ue_mean, place[None], kind)
        ratio = fit(values, after).log_intensity - fit(values).log_intensity
        assert ratio[kind, 0] == pytest.approx(math.log(0.1))


def test_a_path_from_beyond_the_field_of_view_is_no_sp() -> None:
    behind = VA * np.array([-1.0, 1.0, 1.0])
    births = fit(h(STATE.ue_mean, behind[None], 0))
    np.testing.assert_allclose(births.position[0, 0], behind, atol=0.02)
    assert births.log_intensity[1, 0] < births.log_intensity[0, 0] - 50.0


@pytest.mark.parametrize("name", list(CASES))
def test_incidence_points_lie_on_both_rays(name: str) -> None:
    kind, landmark = CASES[name]
    values = h(STATE.ue_mean, landmark[None], kind)
    point = landmark
    if kind == 0:
        normal = (VA - PARAMETERS.bs) / np.linalg.norm(VA - PARAMETERS.bs)
        ue = np.array([*STATE.ue_mean[:2], 0.0])
        share = (0.5 * (VA + PARAMETERS.bs) - ue) @ normal / ((VA - ue) @ normal)
        point = ue + share * (VA - ue)
    for missing in ((), ("aoa_azimuth", "aoa_elevation"), ("path_length",)):
        observed = prepare(
            MeasurementSet(without(values, *missing), np.zeros((1, DIM, DIM))), PARAMETERS
        )
        vehicle, bs = vehicle_of(STATE.ue_mean, 0.0, 0.0), Vec(*PARAMETERS.bs.tolist())
        height = float(PARAMETERS.landmark_height_mean)
        points, located = incidence_points(vehicle, bs, height, observed.values)
        assert located.all()
        np.testing.assert_allclose(points[0], point, atol=1e-6)


def test_no_path_no_birth() -> None:
    births = fit(np.zeros((0, DIM)))
    assert births.position.shape == (2, 0, 3) and births.log_intensity.shape == (2, 0)


def drawn(rng: np.random.Generator, kind: int, place: FloatArray) -> MeasurementSet:
    """Paths of one landmark with correlated noise of their own, most with a component missing."""
    std = np.array([0.1, 0.05, 0.05, 0.05, 0.05, 0.1])
    root = std[:, None] * (np.eye(DIM) + rng.normal(0.0, 0.3, (DIM, DIM)))
    covariance = root @ root.T
    # Less noise than is said: Gauss-Newton gets to the end in the steps it has.
    values = h(STATE.ue_mean, place[None], kind) + 0.3 * rng.normal(size=(8, DIM)) @ root.T
    values[np.arange(1, 8), rng.integers(0, DIM, 7)] = np.nan
    return MeasurementSet(values, np.tile(covariance, (8, 1, 1)))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("name", list(CASES))
def test_the_fit_solves_its_normal_equations(name: str, seed: int) -> None:
    """The printed matrices at the fitted position, reduced to the components that are there."""
    kind, place = CASES[name]
    rng = np.random.default_rng(seed)
    parameters = FilterParameters()
    root = np.diag([0.3, 0.3, 0.005, 0.3]) @ rng.normal(size=(4, 4))
    state = STATE.but(covariance=root @ root.T + 1e-5 * np.eye(4))
    state = state.but(undetected=looked_from(nothing_seen(), 0.0, 0.0, parameters.sp_field_of_view))
    observed = prepare(drawn(rng, kind, place), parameters)
    births = propose(state, observed, SPEED, parameters)
    fitted = np.flatnonzero(np.isfinite(births.log_intensity[kind]))
    assert len(fitted) > 3
    types = np.array([UNKNOWN_TYPES[kind]])
    prior = np.diag([1e-12, 1e-12, parameters.landmark_height_std**-2])
    for path in fitted:
        x = births.position[kind, path]
        paths = observe(state.ue_mean, SPEED, x[None], types, parameters.bs)
        used = observed.used[path]
        a, b = paths.ue_jacobian[0, used], paths.landmark_jacobian[0, used]
        s = observed.noise[path][np.ix_(used, used)] + a @ state.ue_covariance @ a.T
        r = residual(observed.values[path], paths.mean[0])[used]
        information = b.T @ np.linalg.solve(s, b) + prior
        off = np.array([0.0, 0.0, parameters.landmark_height_mean - x[2]])
        step = np.linalg.solve(information, b.T @ np.linalg.solve(s, r) + prior @ off)
        assert step @ information @ step < 1e-4
        covariance = np.linalg.inv(information)
        scale = np.abs(covariance).max()
        np.testing.assert_allclose(births.covariance[kind, path], covariance, atol=1e-7 * scale)
        gain = -covariance @ b.T @ np.linalg.solve(s, a)
        np.testing.assert_allclose(births.gain[kind, path], gain, atol=1e-6 * np.abs(gain).max())
        ray = x - np.append(state.ue_mean[:2], 0.0)
        reach = float(np.linalg.norm(ray))
        spread = math.sqrt(ray @ covariance @ ray) / reach
        away = float(np.linalg.norm(x))  # from where the vehicle has looked before
        seen, before = (0.9 * norm.cdf((50.0 - d) / spread) for d in (reach, away))
        if kind == 0:
            seen, before = 0.9, 0.9
        expected = (
            math.log(parameters.undetected_intensity * seen * (1.0 - before))
            + multivariate_normal(np.zeros(len(r)), s).logpdf(r)
            - 0.5 * off @ prior @ off
            + 1.5 * math.log(2.0 * math.pi)
            - 0.5 * np.linalg.slogdet(information)[1]
        )
        assert births.log_intensity[kind, path] == pytest.approx(expected, abs=1e-6)


def test_paths_that_cannot_be_fitted_leave_the_others_alone() -> None:
    values = np.vstack([h(STATE.ue_mean, place[None], kind) for kind, place in CASES.values()])
    nothing = np.full((1, DIM), np.nan)
    nothing[0, 5] = 3.0
    together = fit(np.vstack([values[:1], nothing, values[1:]]))
    alone = fit(values)
    np.testing.assert_array_equal(together.log_intensity[:, [0, 2]], alone.log_intensity)
    np.testing.assert_array_equal(together.position[:, [0, 2]], alone.position)
    assert (together.log_intensity[:, 1] == -np.inf).all()


def test_a_noise_that_is_no_covariance_gives_no_birth_and_no_nan() -> None:
    values = h(STATE.ue_mean, SP[None], 1)
    observed = prepare(MeasurementSet(values, np.zeros((1, DIM, DIM))), PARAMETERS)
    noise = observed.noise.copy()
    noise[0, 4, 4] = -1.0
    births = propose(STATE, observed._replace(noise=noise), SPEED, PARAMETERS)
    assert (births.log_intensity == -np.inf).all()
    for part in (births.position, births.covariance, births.gain):
        assert np.isfinite(part).all()


@pytest.mark.parametrize("name", list(CASES))
def test_a_full_turn_of_an_azimuth_changes_nothing(name: str) -> None:
    kind, place = CASES[name]
    values = h(STATE.ue_mean, place[None], kind) + 0.02
    births = fit(values)
    for azimuth in ("aoa_azimuth", "aod_azimuth"):
        turned = values.copy()
        turned[:, NAMES[azimuth]] -= 2.0 * math.pi
        same = fit(turned)
        np.testing.assert_allclose(same.position[kind], births.position[kind], atol=1e-6)
        np.testing.assert_allclose(same.log_intensity[kind], births.log_intensity[kind], atol=1e-6)
