"""The PHD filter: a plain EKF and the PHD's own equation as witnesses, then the paper's scene."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2, multivariate_normal, norm

from dopslam_ros.core.linalg.arrays import FloatArray
from dopslam_ros.core.models.measurements import MeasurementSet
from dopslam_ros.core.models.motion import Control, ControlSpan
from dopslam_ros.core.pmb import FilterParameters, initial_posterior, prepare, step
from dopslam_ros.core.settings.layout import DIM, DOPPLER, LandmarkType
from dopslam_ros.core.settings.model import with_doppler_std
from dopslam_ros.lab.baselines.phd import phd_landmarks, phd_step
from dopslam_ros.lab.baselines.phd_map import MOST_COMPONENTS
from dopslam_ros.lab.baselines.phd_state import PhdState, initial_phd
from dopslam_ros.lab.study.plan import run_generator
from dopslam_ros.offline.evaluation import StepRecord, judge_step, summarise
from dopslam_ros.simulation.matched import filter_parameters_for
from dopslam_ros.simulation.scenario import load_scenario
from dopslam_ros.simulation.simulator import all_landmarks, simulate

SPEED, TURN, PERIOD = 22.22, math.pi / 10.0, 0.5
SPAN = ControlSpan(Control(SPEED, TURN), PERIOD)
VA, SP = int(LandmarkType.VA), int(LandmarkType.SP)
BS = np.array([0.0, 0.0, 40.0])
RUNS = 8


def set_of(values: FloatArray) -> MeasurementSet:
    return MeasurementSet(values, np.zeros((len(values), DIM, DIM)))


EMPTY = set_of(np.zeros((0, DIM)))


def with_map(
    parameters: FilterParameters,
    means: FloatArray,
    types: list[int],
    std: float,
    weights: FloatArray | None = None,
) -> PhdState:
    return replace(
        initial_phd(parameters),
        weights=np.ones(len(types)) if weights is None else weights,
        means=np.array(means, dtype=np.float64),
        covariances=np.tile(np.eye(3) * std**2, (len(types), 1, 1)),
        types=np.array(types, dtype=np.int64),
    )


def angles(direction: FloatArray) -> tuple[float, float]:
    return math.atan2(direction[1], direction[0]), math.atan2(
        direction[2], math.hypot(direction[0], direction[1])
    )


def h(s: FloatArray, x: FloatArray, kind: int) -> FloatArray:
    """Eqs. (4) to (11) from the point where the path touches the world."""
    ue = np.array([s[0], s[1], 0.0])
    point = x
    if kind == VA:
        normal = (BS - x) / np.linalg.norm(BS - x)
        part = np.dot(0.5 * (x + BS) - ue, normal) / np.dot(x - ue, normal)
        point = ue + part * (x - ue)
    length = np.linalg.norm(point - ue) + np.linalg.norm(BS - point) + s[3]
    arrival = (point - ue) / np.linalg.norm(point - ue)
    azimuth, elevation = angles(arrival)
    velocity = SPEED * np.array([math.cos(s[2]), math.sin(s[2]), 0.0])
    departure = angles((ue if kind == 0 else point) - BS)
    return np.array([length, azimuth - s[2], elevation, *departure, arrival @ velocity])


def stacked(joint: FloatArray, kinds: list[int]) -> FloatArray:
    """h of the BS and of landmarks, from [s; x_1; x_2 ...]."""
    places = [BS, *joint[4:].reshape(-1, 3)]
    return np.concatenate([h(joint[:4], x, k) for x, k in zip(places, [0, *kinds], strict=True)])


def differences(joint: FloatArray, kinds: list[int]) -> FloatArray:
    columns = [
        (stacked(joint + d, kinds) - stacked(joint - d, kinds)) / 2e-6
        for d in 1e-6 * np.eye(len(joint))
    ]
    return np.stack(columns, axis=1)


# Off the x axis, where the azimuth of the BS is pi and differences of it mean nothing.
START = (70.0, 10.0, math.pi / 2.0, 300.0)
# Nothing but landmarks in sight, always detected: the association is known for certain.
CERTAIN = FilterParameters(
    initial_state=START,
    initial_std=(0.03, 0.03, 0.002, 0.03),
    measurement_noise_std=(0.01, 0.001, 0.001, 0.001, 0.001, 0.01),
    detection_probability=1.0,
    clutter_mean=0.0,
    undetected_intensity=1e-15,
)


def test_the_vehicle_moves_as_in_the_pmb_filter() -> None:
    parameters = FilterParameters()
    spans = [ControlSpan(Control(SPEED, TURN), 0.2), ControlSpan(Control(10.0, 0.0), 0.3)]
    ours = phd_step(initial_phd(parameters), EMPTY, spans, SPEED, parameters)
    start, nothing = initial_posterior(parameters), prepare(EMPTY, parameters)
    other = step(start, nothing, spans, SPEED, parameters)[0].density
    np.testing.assert_allclose(ours.ue_mean, other.ue_mean, rtol=1e-12)
    np.testing.assert_allclose(ours.ue_covariance, other.ue_covariance, rtol=1e-12)
    np.testing.assert_allclose(ours.undetected.viewpoints, other.undetected.viewpoints)
    assert ours.undetected.looks == other.undetected.looks == 1
    assert not len(ours.weights)


@pytest.mark.parametrize("kinds", [[VA], [SP], [VA, SP]])
def test_a_known_association_is_one_joint_ekf_update(kinds: list[int]) -> None:
    rng = np.random.default_rng(3)
    places = np.array([[200.0, 0.0, 40.0], [80.0, 15.0, 10.0]])[[k - 1 for k in kinds]]
    state = with_map(CERTAIN, places, kinds, std=0.02)
    mean = np.concatenate([state.ue_mean, places.ravel()])
    prior = np.diag(np.square([*CERTAIN.initial_std, *[0.02] * 3 * len(kinds)]))
    noise = np.tile(CERTAIN.measurement_noise_std, 1 + len(kinds))
    truth = rng.multivariate_normal(mean, prior)
    z = stacked(truth, kinds) + noise * rng.standard_normal(len(noise))

    jacobian = differences(mean, kinds)
    s = jacobian @ prior @ jacobian.T + np.diag(noise**2)
    gain = np.linalg.solve(s, jacobian @ prior).T
    expected = mean + gain @ (z - stacked(mean, kinds))
    covariance = prior - gain @ s @ gain.T

    after = phd_step(state, set_of(z.reshape(-1, DIM)), [], SPEED, CERTAIN)
    order = [after.types.tolist().index(kind) for kind in kinds]
    np.testing.assert_allclose(after.weights[order], 1.0, atol=1e-6)
    assert len(after.weights) == len(kinds)
    got = np.concatenate([after.ue_mean, after.means[order].ravel()])
    assert np.abs(got - mean).max() > 0.01
    # What is left is the bend of the path length, which the EKF of the test does not know.
    np.testing.assert_allclose(got, expected, atol=1e-4)
    blocks = [covariance[i : i + 3, i : i + 3] for i in range(4, len(mean), 3)]
    np.testing.assert_allclose(after.ue_covariance, covariance[:4, :4], atol=2e-7)
    np.testing.assert_allclose(after.covariances[order], blocks, atol=2e-7)


def test_an_ambiguous_bs_path_moves_the_vehicle_as_in_the_pmb_filter() -> None:
    # Without a map the two filters are one: two paths compete for the BS, or are clutter.
    parameters = FilterParameters(
        initial_state=(*START[:2], math.pi - 1e-3, START[3]),
        initial_std=(0.3, 0.3, 0.2, 3.0),
        measurement_noise_std=(1.0, 0.1, 0.1, 0.1, 0.1, 3.0),
        clutter_mean=1e4,
    )
    state = initial_phd(parameters)
    sure = h(state.ue_mean, BS, 0)
    z = sure + np.array([[4.0, -0.4, 0.0, 0.1, 0.1, 0.0], [-6.0, -0.4, 0.1, 0.1, 0.1, 0.0]])
    start, observed = initial_posterior(parameters), prepare(set_of(z), parameters)
    other, said = step(start, observed, [], SPEED, parameters)
    assert 0.05 < said.weight[1] and other.ue_mean[2] < -2.5
    ours = phd_step(state, set_of(z), [], SPEED, parameters)
    np.testing.assert_allclose(ours.ue_mean, other.ue_mean, atol=2e-3)
    np.testing.assert_allclose(ours.ue_covariance, other.ue_covariance, atol=5e-3)


def test_the_weights_follow_the_phd_recursion() -> None:
    # The vehicle is known; two walls compete for a path, a third one is not seen.
    parameters = FilterParameters(
        initial_state=START,
        initial_std=(1e-6,) * 4,
        measurement_noise_std=(1.0, 0.3, 0.3, 0.3, 0.3, 3.0),
        undetected_intensity=1e-15,
        clutter_mean=1e4,
    )
    places = np.array([[200.0, 0.0, 40.0], [200.5, 4.0, 40.0], [0.0, 200.0, 40.0]])
    weights = np.array([0.7, 0.4, 0.9])
    state = with_map(parameters, places, [VA] * 3, std=0.1, weights=weights)
    z = h(state.ue_mean, places[0], VA)
    z += np.array([1.5, 0.4, -0.4, 0.3, 0.3, 1.0])
    likelihood = []
    for x in places:
        b = differences(np.concatenate([state.ue_mean, x]), [VA])[DIM:, 4:]
        s = 0.01 * b @ b.T + np.diag(np.square(parameters.measurement_noise_std))
        likelihood.append(multivariate_normal.pdf(z, h(state.ue_mean, x, VA), s))
    volume = 400.0 * (2.0 * math.pi * math.pi) ** 2 * 50.0
    detected = 0.9 * weights * np.array(likelihood)
    share = detected / (1e4 / volume + detected.sum())
    assert 0.2 < share[0] < 0.8 and 0.05 < share[1] and share[2] < 1e-9

    after = phd_step(state, set_of(z[None]), [], SPEED, parameters)
    nearest = np.argmin(np.linalg.norm(after.means[:, None] - places[None], axis=2), axis=1)
    got = np.bincount(nearest, after.weights, minlength=3)
    np.testing.assert_allclose(got, 0.1 * weights + share, rtol=0.01)


def test_a_birth_knows_where_all_other_paths_place_the_vehicle() -> None:
    parameters = FilterParameters(
        initial_state=START,
        initial_std=(1.0, 1.0, 0.02, 1.0),
        measurement_noise_std=(0.1, 0.005, 0.005, 0.005, 0.005, 0.1),
    )
    rng = np.random.default_rng(8)
    start = initial_phd(parameters)
    place = np.array([200.0, 0.0, 40.0])
    normalised, spreads = [], []
    for _ in range(200):
        truth = rng.multivariate_normal(start.ue_mean, start.ue_covariance)
        z = np.stack([h(truth, BS, 0), h(truth, place, VA)])
        z += parameters.measurement_noise_std * rng.standard_normal(z.shape)
        after = phd_step(start, set_of(z), [], SPEED, parameters)
        assert after.types[0] == VA and after.weights[0] > 0.9
        error = after.means[0] - place
        normalised.append(error @ np.linalg.solve(after.covariances[0], error))
        spreads.append(np.trace(after.covariances[0]))
    alone = phd_step(start, set_of(z[1:]), [], SPEED, parameters)
    assert np.mean(spreads) < 0.5 * np.trace(alone.covariances[0])
    low, high = chi2.ppf([1e-3, 1.0 - 1e-3], 3 * len(normalised)) / len(normalised)
    assert low < np.mean(normalised) < high


def test_what_is_not_seen_fades_only_where_it_could_be_seen() -> None:
    parameters = FilterParameters()
    x, y = parameters.initial_state[:2]
    # In sight, out of sight, at the edge of it, and a wall that can have no path.
    places = [[200.0, 0.0, 40.0], [-99.0, 0.0, 10.0], [x, y + 50.2, 0.0], BS]
    weights = np.array([0.8, 0.7, 0.6, 0.5])
    state = with_map(parameters, np.array(places), [VA, SP, SP, VA], std=0.5, weights=weights)
    after = phd_step(state, EMPTY, [], SPEED, parameters)
    edge = 0.6 * (1.0 - 0.9 * norm.cdf(-0.2 / math.hypot(0.5, 0.3)))
    np.testing.assert_allclose(after.weights, [0.7, 0.5, edge, 0.08], rtol=1e-9)
    assert phd_landmarks(after, parameters).types.tolist() == [SP, VA]


def test_a_path_outside_every_gate_changes_nothing() -> None:
    parameters = replace(CERTAIN, detection_probability=0.9)
    state = with_map(parameters, np.array([[200.0, 0.0, 40.0]]), [VA], std=0.02)
    # Eight standard deviations: still likelier than a birth, of which there is hardly any.
    far = h(state.ue_mean, BS, 0) + np.array([0.0, 0.0, 0.008, 0.0, 0.0, 0.0])
    after = phd_step(state, set_of(far[None]), [], SPEED, parameters)
    np.testing.assert_allclose(after.ue_mean, state.ue_mean)
    np.testing.assert_allclose(after.weights[after.types == VA][-1], 0.1)
    np.testing.assert_allclose(after.ue_covariance, state.ue_covariance)


def test_near_components_of_a_type_merge_into_their_moments() -> None:
    parameters = FilterParameters()
    # Out of sight, so that the weights stay; the VA cannot be but is another type.
    places = np.array([[-99.0, 0.0, 10.0], [-98.4, 0.0, 10.0], [-90.0, 0.0, 10.0], [-99.0, 0, 10]])
    weights = np.array([0.6, 0.2, 0.5, 0.4])
    state = with_map(parameters, places, [SP, SP, SP, VA], std=0.5, weights=weights)
    after = phd_step(state, EMPTY, [], SPEED, parameters)
    np.testing.assert_allclose(after.weights, [0.8, 0.5, 0.04])
    assert after.types.tolist() == [SP, SP, VA]
    np.testing.assert_allclose(after.means[0], [-98.85, 0.0, 10.0])
    spread = np.diag([0.25 + 0.75 * 0.25 * 0.6**2, 0.25, 0.25])
    np.testing.assert_allclose(after.covariances[0], spread, atol=1e-12)


def test_the_mixture_is_capped_and_pruned() -> None:
    parameters = FilterParameters()
    count = MOST_COMPONENTS + 50
    places = np.stack([np.full(count, -99.0), 10.0 * np.arange(count), np.zeros(count)], axis=1)
    weights = np.linspace(0.1, 0.9, count)
    weights[100] = 0.5 * parameters.prune_existence
    state = with_map(parameters, places, [SP] * count, std=0.5, weights=weights)
    after = phd_step(state, EMPTY, [], SPEED, parameters)
    np.testing.assert_allclose(after.weights, np.sort(weights)[::-1][:MOST_COMPONENTS])
    few = replace(
        state,
        weights=weights[90:110],
        means=places[90:110],
        covariances=state.covariances[90:110],
        types=state.types[90:110],
    )
    assert len(phd_step(few, EMPTY, [], SPEED, parameters).weights) == 19


def test_only_what_is_likely_and_well_placed_is_reported() -> None:
    parameters = FilterParameters()
    places = np.array([[200.0, 0.0, 40.0], [1.0, 2.0, 3.0], [4.0, 5.0, 6.0], [7.0, 8.0, 9.0]])
    weights = np.array([1.1, 0.6, 0.4, 0.9])
    state = with_map(parameters, places, [VA, SP, SP, SP], std=0.5, weights=weights)
    state.covariances[3] *= 1e4
    landmarks = phd_landmarks(state, parameters)
    assert landmarks.ids.tolist() == [1, 2] and landmarks.types.tolist() == [VA, SP]
    np.testing.assert_allclose(landmarks.existence, [1.0, 0.6])
    np.testing.assert_allclose(landmarks.type_probabilities, [[0, 1, 0], [0, 0, 1]])
    np.testing.assert_allclose(landmarks.positions, places[:2])
    np.testing.assert_allclose(landmarks.covariances, state.covariances[:2])


def finite(state: PhdState) -> bool:
    numbers = (state.ue_mean, state.ue_covariance, state.weights, state.means, state.covariances)
    positive = np.linalg.eigvalsh(state.ue_covariance)[0] > 0.0
    return bool(positive) and all(np.isfinite(array).all() for array in numbers)


def test_a_set_without_doppler_is_used_without_it() -> None:
    scenario = load_scenario("paper")
    parameters = filter_parameters_for(scenario)
    without = filter_parameters_for(with_doppler_std(scenario, None))
    given = ignoring = initial_phd(parameters)
    for snapshot in list(simulate(scenario, np.random.default_rng(4)))[:8]:
        values = snapshot.measurements.values.copy()
        values[:, DOPPLER] = np.nan
        given = phd_step(given, set_of(values), [SPAN], SPEED, parameters)
        ignoring = phd_step(ignoring, snapshot.measurements, [SPAN], SPEED, without)
    assert finite(given) and len(given.weights)
    np.testing.assert_array_equal(given.ue_mean, ignoring.ue_mean)
    np.testing.assert_array_equal(given.means, ignoring.means)


@pytest.mark.parametrize("detection_probability", [0.0, 0.9, 1.0])
@pytest.mark.parametrize("clutter_mean", [0.0, 1.0])
def test_singular_geometry_and_odd_paths_give_numbers(
    detection_probability: float, clutter_mean: float
) -> None:
    parameters = FilterParameters(
        detection_probability=detection_probability, clutter_mean=clutter_mean
    )
    x, y = parameters.initial_state[:2]
    # At and above the vehicle, at the BS, a wall through the vehicle, a wall under the BS.
    places = np.array([[x, y, 0], [x, y, 40], [0, 0, 40], [2 * x, 0, -40], [0, 0, -40]])
    state = with_map(parameters, np.vstack([places, places]), [VA] * 5 + [SP] * 5, std=0.5)
    z = np.stack([h(state.ue_mean, BS, 0), h(state.ue_mean, np.array([200.0, 3.0, 40.0]), VA)])
    odd = np.full((3, DIM), np.nan)
    odd[0, 0] = odd[2, 2] = 1.0
    odd[1, 1:3] = (3.0, -1.5)
    for values in (z, odd, np.vstack([z, z, z, odd])):
        after = state
        for _ in range(3):
            after = phd_step(after, set_of(values), [SPAN], SPEED, parameters)
            assert finite(after)
            phd_landmarks(after, parameters)


def paper_run(sigma_d: float | None, run: int) -> tuple[list[StepRecord], list[PhdState]]:
    scenario = with_doppler_std(load_scenario("paper"), sigma_d)
    parameters = filter_parameters_for(scenario)
    positions, types = all_landmarks(scenario)
    state, spans = initial_phd(parameters), list[ControlSpan]()
    records, states = [], []
    for snapshot in simulate(scenario, run_generator(5, run)):
        speed = snapshot.control.speed
        state = phd_step(state, snapshot.measurements, spans, speed, parameters)
        spans = [ControlSpan(snapshot.control, scenario.period)]
        landmarks = phd_landmarks(state, parameters)
        vas, sps = positions[types == VA], positions[types == SP]
        records.append(
            judge_step(
                state.ue_mean, state.ue_covariance, landmarks, snapshot.state, vas, sps, None
            )
        )
        states.append(state)
    return records, states


@pytest.mark.parametrize("sigma_d, largest", [(0.1, 0.6), (None, 0.9)])
def test_the_paper_scene_is_tracked_and_mapped(sigma_d: float | None, largest: float) -> None:
    runs = [paper_run(sigma_d, run) for run in range(RUNS)]
    summary = summarise([record for records, _ in runs for record in records])
    assert summary["position_rmse"] < largest
    assert summary["heading_rmse_deg"] < 0.5
    assert summary["clock_bias_rmse"] < 0.4
    # A path missed costs the landmark its weight for a step: 10 m of GOSPA, four in ten steps.
    for name in ("gospa_va", "gospa_sp"):
        assert np.mean(np.reshape(summary[name], (RUNS, -1))[:, -10:]) < 11.0
    # A PHD integrates to the expected number of landmarks: eight, once all have been near.
    count = np.mean([[state.weights.sum() for state in states[-10:]] for _, states in runs])
    assert 7.3 < count < 8.7
    assert all(finite(state) for _, states in runs for state in states)


def test_a_run_is_the_same_every_time() -> None:
    (_, first), (_, second) = paper_run(0.1, 0), paper_run(0.1, 0)
    np.testing.assert_array_equal(first[-1].ue_mean, second[-1].ue_mean)
    np.testing.assert_array_equal(first[-1].weights, second[-1].weights)
    np.testing.assert_array_equal(first[-1].means, second[-1].means)
