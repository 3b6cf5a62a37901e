"""Landmarks out of view: the filter that keeps everything active as the witness."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dopslam_ros.core.linalg.arrays import FloatArray
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
from dopslam_ros.core.pmb import step as step_function
from dopslam_ros.core.pmb.coordinates import frames, local_coordinates
from dopslam_ros.core.pmb.inactive import FORGOTTEN, current, deactivate, reactivate
from dopslam_ros.core.pmb.inactive_grid import InactiveGrid, InactiveLandmarks, together
from dopslam_ros.core.pmb.posterior import all_ids, posterior_of
from dopslam_ros.core.settings.model import with_doppler_std
from dopslam_ros.simulation.matched import filter_parameters_for
from dopslam_ros.simulation.scenario import load_scenario
from dopslam_ros.simulation.simulator import simulate

PARAMETERS = FilterParameters()
VA, SP = 1, 2
NOTHING = InactiveGrid()


def state_with(
    positions: list[list[float]],
    types: list[int],
    seed: int = 0,
    existence: float = 0.9999,
) -> Density:
    """Tracks of one component each, everything correlated with everything; vehicle at (0, 0)."""
    rng = np.random.default_rng(seed)
    place = np.array(positions)
    origin = np.tile([1.0, -2.0, 0.0], (len(place), 1))
    axes = frames(place - origin)
    n = 4 + 3 * len(place)
    root = rng.normal(size=(n, n))
    correlation = root @ root.T + 2.0 * np.eye(n)
    scale = np.sqrt(np.diag(correlation))
    std = np.concatenate([[0.3, 0.3, 0.01, 0.3], np.tile([0.3, 0.004, 0.004], len(place))])
    start = initial_density(PARAMETERS)
    return start.but(
        mean=np.concatenate(
            [[0.0, 0.0, 1.0, 300.0], local_coordinates(origin, axes, place).ravel()]
        ),
        covariance=correlation / np.outer(scale, scale) * np.outer(std, std),
        origin=origin,
        axes=axes,
        component_track=np.arange(len(place)),
        component_type=np.array(types),
        component_weight=np.ones(len(place)),
        track_id=np.arange(1, len(place) + 1),
        existence=np.full(len(place), existence),
        next_id=len(place) + 1,
    )


FAR, NEAR = [130.0, 10.0, 5.0], [20.0, 5.0, 3.0]
SCENE = ([[200.0, 0.0, 40.0], FAR, NEAR, [0.0, 200.0, 40.0], [-90.0, -100.0, 8.0]], [1, 2, 2, 1, 2])


def moved(state: Density, x: float, y: float) -> Density:
    mean = state.mean.copy()
    mean[:2] = x, y
    return state.but(mean=mean)


def test_only_scattering_points_out_of_view_become_inactive() -> None:
    state, inactive = deactivate(state_with(*SCENE), NOTHING, PARAMETERS)
    assert state.track_id.tolist() == [1, 3, 4]
    assert sorted(all_ids(state, inactive).tolist()) == [1, 2, 3, 4, 5]
    assert len(inactive) == 2
    for unchanged in (deactivate, reactivate):
        again, same = unchanged(state, inactive, PARAMETERS)
        assert again is state and same is inactive


def test_what_was_inactive_while_nothing_happened_is_as_it_was_given_the_anchors() -> None:
    before = state_with(*SCENE)
    state, inactive = deactivate(before, NOTHING, PARAMETERS)
    after, rest = reactivate(moved(state, 120.0, 0.0), inactive, PARAMETERS)
    assert after.track_id.tolist() == [1, 3, 4, 2]
    assert len(rest) == 1
    old = np.r_[7:10]  # track 2 before, now the last block
    new = np.r_[13:16]
    anchors_old, anchors_new = np.r_[4:7, 13:16], np.r_[4:7, 10:13]
    np.testing.assert_allclose(after.mean[new], before.mean[old])
    p, q = before.covariance, after.covariance
    np.testing.assert_allclose(q[np.ix_(new, new)], p[np.ix_(old, old)], atol=1e-12)
    np.testing.assert_allclose(q[np.ix_(new, anchors_new)], p[np.ix_(old, anchors_old)], atol=1e-12)
    # With the vehicle it has in common what goes through the anchors.
    gain = np.linalg.solve(p[np.ix_(anchors_old, anchors_old)], p[np.ix_(anchors_old, old)]).T
    np.testing.assert_allclose(
        q[np.ix_(new, np.r_[:4])], gain @ p[np.ix_(anchors_old, np.r_[:4])], atol=1e-12
    )
    assert np.linalg.eigvalsh(q)[0] > 0.0


def test_an_inactive_landmark_learns_what_its_anchors_learn() -> None:
    """As a Kalman update of all would have it, were it independent of the rest given them."""
    before = state_with(*SCENE)
    active, inactive = deactivate(before, NOTHING, PARAMETERS)
    old, anchors = np.r_[7:10], np.r_[4:7, 13:16]
    learnt = active.mean.copy()
    learnt[[4, 5, 6, 10, 11, 12]] += [0.1, 0.002, 0.0, -0.2, 0.0, 0.001]
    shrunk = active.covariance.copy()
    factor = np.ones(len(shrunk))
    factor[[4, 5, 6, 10, 11, 12]] = 0.5
    state = active.but(mean=learnt, covariance=shrunk * np.outer(factor, factor))
    landmarks = inactive.landmarks
    assert landmarks is not None
    q, covariance = current(state, landmarks)
    row = landmarks.track_id.tolist().index(2)
    p = before.covariance
    gain = np.linalg.solve(p[np.ix_(anchors, anchors)], p[np.ix_(anchors, old)]).T
    np.testing.assert_allclose(
        q[row] - before.mean[old], gain @ np.array([0.1, 0.002, 0.0, -0.2, 0.0, 0.001])
    )
    explained = gain @ p[np.ix_(anchors, old)]
    expected = p[np.ix_(old, old)] - 0.75 * explained
    np.testing.assert_allclose(covariance[row], expected, atol=1e-12)


def test_without_its_anchor_an_inactive_landmark_is_what_it_was() -> None:
    before = state_with(*SCENE)
    state, inactive = deactivate(before, NOTHING, PARAMETERS)
    lost = state.only(np.array([False, True, True]), np.array([False, True, True]))
    after, _ = reactivate(moved(lost, 120.0, 0.0), inactive, PARAMETERS)
    np.testing.assert_allclose(after.mean[-3:], before.mean[7:10])
    np.testing.assert_allclose(after.covariance[-3:, -3:], before.covariance[7:10, 7:10])
    assert not after.covariance[-3:, :-3].any()


def test_a_map_without_anchors_becomes_inactive_too() -> None:
    before = state_with([FAR, NEAR], [SP, SP])
    state, inactive = deactivate(before, NOTHING, PARAMETERS)
    assert state.track_id.tolist() == [2]
    after, _ = reactivate(moved(state, 120.0, 0.0), inactive, PARAMETERS)
    np.testing.assert_allclose(after.covariance[-3:, -3:], before.covariance[4:7, 4:7])


def test_what_hardly_exists_is_forgotten_when_it_is_left_behind() -> None:
    state = state_with(*SCENE)
    existence = state.existence.copy()
    existence[[1, 2]] = 0.5 * FORGOTTEN
    state, inactive = deactivate(state.but(existence=existence), NOTHING, PARAMETERS)
    assert sorted(all_ids(state, inactive).tolist()) == [1, 3, 4, 5]


def test_the_reported_map_holds_those_inactive() -> None:
    before = state_with(*SCENE)
    shown = reported_landmarks(posterior_of(before, NOTHING), PARAMETERS)
    after = posterior_of(*deactivate(before, NOTHING, PARAMETERS))
    inactive = reported_landmarks(after, PARAMETERS)
    np.testing.assert_array_equal(inactive.ids, shown.ids)
    np.testing.assert_array_equal(inactive.types, shown.types)
    np.testing.assert_allclose(inactive.positions, shown.positions, atol=1e-9)
    np.testing.assert_allclose(inactive.covariances, shown.covariances, atol=1e-9)


def landmarks_at(place: FloatArray, distance: FloatArray, anchors: int) -> InactiveLandmarks:
    count = len(place)
    return InactiveLandmarks(
        track_id=np.arange(count),
        existence=np.ones(count),
        reactivation_distance=distance,
        position=place,
        origin=np.zeros((count, 3)),
        axes=np.tile(np.eye(3), (count, 1, 1)),
        q=place,
        covariance=np.tile(np.eye(3), (count, 1, 1)),
        anchors=np.ones((count, anchors), dtype=np.int64),
        anchor_q=np.zeros((count, 3 * anchors)),
        gain=np.zeros((count, 3, 3 * anchors)),
        residual=np.tile(np.eye(3), (count, 1, 1)),
    )


@pytest.mark.parametrize("seed", range(5))
def test_the_grid_finds_what_a_search_through_all_finds(seed: int) -> None:
    rng = np.random.default_rng(seed)
    place, distance = rng.uniform(-600.0, 600.0, (800, 3)), rng.uniform(20.0, 90.0, 800)
    inactive = InactiveGrid()
    landmarks = landmarks_at(place, distance, 2)
    for rows in np.array_split(rng.permutation(800), 40):
        inactive = inactive.with_more(landmarks.rows(rows), 50.0)
    assert len(inactive) == 800
    for ue in rng.uniform(-700.0, 700.0, (30, 2)):
        found, rest = inactive.take(ue, 1.5, 50.0)
        near = np.flatnonzero(np.linalg.norm(place[:, :2] - ue, axis=1) <= distance + 1.5)
        assert sorted([] if found is None else found.track_id.tolist()) == near.tolist()
        assert len(rest) == 800 - len(near) and len(inactive) == 800


def test_landmarks_with_different_numbers_of_anchors_go_together() -> None:
    rng = np.random.default_rng(1)
    parts = [landmarks_at(rng.normal(size=(3, 3)), np.ones(3), count) for count in (0, 2, 1)]
    both = together(parts)
    assert both.anchors.tolist() == [[0, 0]] * 3 + [[1, 1]] * 3 + [[1, 0]] * 3
    assert both.gain.shape == (9, 3, 6) and both.anchor_q.shape == (9, 6)


@pytest.mark.parametrize("doppler", [0.1, None])
def test_two_laps_give_what_a_filter_gives_that_keeps_all_active(
    doppler: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first SP comes into view again after 27 steps inactive."""
    scenario = with_doppler_std(load_scenario("paper"), doppler)
    scenario = replace(scenario, controls=(Control(22.22, np.pi / 10.0),) * 60)
    parameters = filter_parameters_for(scenario)
    span = [ControlSpan(scenario.controls[0], scenario.period)]

    def run() -> tuple[list[Posterior], int]:
        state, states, least = initial_posterior(parameters), [], 99
        for snapshot in simulate(scenario, np.random.default_rng(2)):
            spans = span if snapshot.step else []
            observed = prepare(snapshot.measurements, parameters)
            state, _ = step(state, observed, spans, 22.22, parameters)
            states.append(state)
            least = min(least, len(state.density.track_id)) if snapshot.step > 30 else least
        return states, least

    reduced, fewest = run()
    module = __import__("sys").modules[step_function.__module__]
    monkeypatch.setattr(module, "deactivate", lambda density, inactive, _: (density, inactive))
    active, fewest_active = run()
    assert fewest < fewest_active
    for one, other in zip(reduced, active, strict=True):
        sigma = np.sqrt(np.diag(other.ue_covariance))
        assert np.all(np.abs(one.ue_mean - other.ue_mean) < 0.1 * sigma)
        ratio = np.diag(one.ue_covariance) / np.diag(other.ue_covariance)
        assert np.all(np.abs(ratio - 1.0) < 0.03)
