"""The Gaussian update: the linear Kalman filter and mixture moments as witnesses."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag

from dopslam_ros.core.arrays import BoolArray, FloatArray
from dopslam_ros.core.assignment import UNASSIGNED
from dopslam_ros.core.channel import DIM
from dopslam_ros.core.filter import FilterParameters, FilterState, initial_filter_state
from dopslam_ros.core.filter.birth import Births
from dopslam_ros.core.filter.evidence import Evidence, Observed
from dopslam_ros.core.filter.hypotheses import Hypotheses, LocalWeights
from dopslam_ros.core.filter.placement import frames
from dopslam_ros.core.filter.update import (
    Augmented,
    Outcomes,
    augment,
    condition,
    judge,
    merge,
    newborn,
    prune,
)

PARAMETERS = FilterParameters()


def random_covariance(rng: np.random.Generator, *shape: int) -> FloatArray:
    root = rng.normal(size=(*shape, shape[-1]))
    return root @ np.swapaxes(root, -1, -2) + 0.5 * np.eye(shape[-1])


def state_of(
    rng: np.random.Generator, tracks: list[list[int]], existence: float = 0.9
) -> FilterState:
    """A random density; ``tracks`` has the types of each track's components."""
    kinds = [kind for track in tracks for kind in track]
    owner = [number for number, track in enumerate(tracks) for _ in track]
    n = 4 + 3 * len(kinds)
    return replace(
        initial_filter_state(PARAMETERS),
        mean=rng.normal(0.0, 5.0, n),
        covariance=random_covariance(rng, n),
        origin=rng.normal(0.0, 50.0, (len(kinds), 3)),
        axes=frames(rng.normal(size=(len(kinds), 3))),
        component_track=np.array(owner, dtype=np.int64),
        component_type=np.array(kinds, dtype=np.int64),
        component_weight=np.array([1.0 / len(track) for track in tracks for _ in track]),
        track_id=np.arange(1, len(tracks) + 1),
        existence=np.full(len(tracks), existence),
        next_id=len(tracks) + 1,
    )


def linear_problem(
    rng: np.random.Generator, state: FilterState, used: BoolArray
) -> tuple[Observed, Evidence]:
    """Paths of a linear model: z = A_i s + B_i q_i + noise."""
    sources, count = len(state.component_track) + 1, len(used)
    a = rng.normal(size=(sources, DIM, 4))
    b = rng.normal(size=(sources, DIM, 3))
    b[0] = 0.0
    h = a @ state.ue_mean
    h[1:] += np.einsum("mij,mj->mi", b[1:], state.placements)
    z = rng.normal(0.0, 5.0, (count, DIM))
    both = used[:, :, None] & used[:, None, :]
    noise = np.where(both, random_covariance(rng, count, DIM), np.eye(DIM))
    innovation = np.where(used, z - h[:, None, :], 0.0)
    fit = Evidence(
        ue_jacobian=a,
        landmark_jacobian=b,
        detection=np.full(sources, 0.9),
        innovation=innovation,
        log_likelihood=np.zeros((sources, count)),
    )
    return Observed(np.where(used, z, np.nan), used, noise), fit


def kalman(
    state: FilterState, observed: Observed, fit: Evidence, source: list[int]
) -> tuple[FloatArray, FloatArray]:
    """The textbook update in information form, one row of H per component that was measured."""
    information = np.linalg.inv(state.covariance)
    vector = information @ state.mean
    for path, i in enumerate(source):
        if i == UNASSIGNED:
            continue
        h = np.zeros((DIM, len(state.mean)))
        h[:, :4] = fit.ue_jacobian[i]
        if i > 0:
            h[:, 1 + 3 * i : 4 + 3 * i] = fit.landmark_jacobian[i]
        has = observed.used[path]
        noise = observed.noise[path]
        precision = np.linalg.inv(noise[np.ix_(has, has)])
        information = information + h[has].T @ precision @ h[has]
        vector = vector + h[has].T @ precision @ observed.values[path][has]
    covariance = np.linalg.inv(information)
    return covariance @ vector, covariance


def joint_nis(state: FilterState, observed: Observed, fit: Evidence, source: list[int]) -> float:
    """v' S^-1 v with all rows of H, and so all of S, in one piece."""
    rows, noises, innovations = [np.zeros((0, len(state.mean)))], [], [np.zeros(0)]
    for path, i in enumerate(source):
        if i == UNASSIGNED:
            continue
        has, h = observed.used[path], np.zeros((DIM, len(state.mean)))
        h[:, :4] = fit.ue_jacobian[i]
        if i > 0:
            h[:, 1 + 3 * i : 4 + 3 * i] = fit.landmark_jacobian[i]
        rows.append(h[has])
        noises.append(observed.noise[path][np.ix_(has, has)])
        innovations.append(observed.values[path][has] - h[has] @ state.mean)
    h, v = np.vstack(rows), np.concatenate(innovations)
    s = h @ state.covariance @ h.T + block_diag(np.zeros((0, 0)), *noises)
    return float(v @ np.linalg.solve(s, v))


@pytest.mark.parametrize("seed", range(8))
def test_condition_is_the_linear_kalman_filter(seed: int) -> None:
    rng = np.random.default_rng(seed)
    state = state_of(rng, [[1, 2], [2], [1]])
    used = rng.random((4, DIM)) < (0.7 if seed % 2 else 1.0)
    used[:, 1] = True
    observed, fit = linear_problem(rng, state, used)
    source = [[0, 3, UNASSIGNED, 2], [UNASSIGNED, 4, 1, 3], [UNASSIGNED] * 4, [0, 1, 3, 4]]
    ranked = Hypotheses(np.array(source), np.array(source), np.full(4, 0.25), 0.0)
    means, covariances, nis = condition(state, observed, fit, ranked)
    for row, sources in enumerate(source):
        mean, covariance = kalman(state, observed, fit, sources)
        np.testing.assert_allclose(means[row], mean, rtol=1e-8, atol=1e-8)
        np.testing.assert_allclose(covariances[row], covariance, rtol=1e-8, atol=1e-8)
        assert np.linalg.eigvalsh(covariances[row])[0] > 0.0
        assert nis[row] == pytest.approx(joint_nis(state, observed, fit, sources), rel=1e-8)


def test_condition_with_one_hypothesis_only() -> None:
    rng = np.random.default_rng(30)
    state = state_of(rng, [[2]])
    observed, fit = linear_problem(rng, state, np.ones((2, DIM), dtype=bool))
    source = np.array([[1, 0]])
    means, covariances, _ = condition(
        state,
        observed,
        fit,
        Hypotheses(source, source, np.ones(1), 0.0),
    )
    mean, covariance = kalman(state, observed, fit, [1, 0])
    np.testing.assert_allclose(means[0], mean, rtol=1e-8)
    np.testing.assert_allclose(covariances[0], covariance, rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("paths", [0, 2])
def test_condition_without_any_assignment_is_the_prediction(paths: int) -> None:
    rng = np.random.default_rng(31)
    state = state_of(rng, [[2]])
    observed, fit = linear_problem(rng, state, np.ones((paths, DIM), dtype=bool))
    source = np.full((1, paths), UNASSIGNED)
    means, covariances, _ = condition(
        state,
        observed,
        fit,
        Hypotheses(source, source, np.ones(1), 0.0),
    )
    np.testing.assert_allclose(means[0], state.mean, rtol=1e-12)
    np.testing.assert_allclose(covariances[0], state.covariance, rtol=1e-12)


def gaussian(state: FilterState, count: int) -> tuple[FloatArray, FloatArray]:
    """The prediction under each of some hypotheses."""
    return np.repeat(state.mean[None], count, 0), np.repeat(state.covariance[None], count, 0)


def alone(state: FilterState, paths: int) -> Augmented:
    """Without births."""
    return Augmented(state, *gaussian(state, 1), np.full(paths, UNASSIGNED))


def mixture(
    rng: np.random.Generator, tracks: list[list[int]], hypotheses: int
) -> tuple[Augmented, FloatArray, FloatArray, Hypotheses]:
    state = state_of(rng, tracks)
    n = len(state.mean)
    means = state.mean + rng.normal(0.0, 1.0, (hypotheses, n))
    covariances = random_covariance(rng, hypotheses, n)
    weight = rng.dirichlet(np.ones(hypotheses))
    none = np.full((hypotheses, 0), UNASSIGNED)
    augmented = Augmented(state, means, covariances, np.zeros(0, dtype=np.int64))
    return augmented, means, covariances, Hypotheses(none, none, weight, 0.0)


@pytest.mark.parametrize("seed", range(5))
def test_merge_of_sure_landmarks_has_the_moments_of_the_mixture(seed: int) -> None:
    rng = np.random.default_rng(seed)
    augmented, means, covariances, ranked = mixture(rng, [[1], [2]], 4)
    sure = Outcomes(np.ones((4, 2)), np.ones((4, 2)))
    merged = merge(augmented, sure, ranked, PARAMETERS)
    w = ranked.weight
    mean = w @ means
    second = sum(w[h] * (covariances[h] + np.outer(means[h], means[h])) for h in range(4))
    np.testing.assert_allclose(merged.mean, mean)
    np.testing.assert_allclose(merged.covariance, second - np.outer(mean, mean), atol=1e-10)
    np.testing.assert_allclose(merged.existence, 1.0)


def test_merge_against_sampling() -> None:
    rng = np.random.default_rng(9)
    augmented, means, covariances, ranked = mixture(rng, [[2]], 3)
    sure = Outcomes(np.ones((3, 1)), np.ones((3, 1)))
    merged = merge(augmented, sure, ranked, PARAMETERS)
    which = rng.choice(3, 60_000, p=ranked.weight)
    roots = np.linalg.cholesky(covariances)
    noise = rng.normal(size=(60_000, 7))
    drawn = means[which] + np.einsum("sij,sj->si", roots[which], noise)
    scale = np.sqrt(np.diag(merged.covariance))
    np.testing.assert_allclose((drawn.mean(axis=0) - merged.mean) / scale, 0.0, atol=0.02)
    np.testing.assert_allclose(
        (np.cov(drawn.T) - merged.covariance) / np.outer(scale, scale), 0.0, atol=0.03
    )


@pytest.mark.parametrize("coupling", ["joint", "marginal"])
@pytest.mark.parametrize("seed", range(10))
def test_merge_weights_every_component_by_what_supports_it(seed: int, coupling: str) -> None:
    rng = np.random.default_rng(seed)
    augmented, means, covariances, ranked = mixture(rng, [[1, 2], [2], [1]], 5)
    existence = rng.random((5, 3))
    existence[rng.random((5, 3)) < 0.3] = 0.0
    share = rng.random(5)
    outcomes = Outcomes(existence, np.stack([share, 1.0 - share, np.ones(5), np.ones(5)], 1))
    parameters = replace(PARAMETERS, coupling=coupling)
    merged = merge(augmented, outcomes, ranked, parameters)

    w = ranked.weight
    owner = augmented.state.component_track
    blocks = [slice(0, 4), *(slice(4 + 3 * c, 7 + 3 * c) for c in range(4))]
    support = [w, *(w * existence[:, owner[c]] * outcomes.type_weight[:, c] for c in range(4))]
    for block, weights in zip(blocks, support, strict=True):
        if weights.sum() == 0.0:
            continue
        v = weights / weights.sum()
        mean = v @ means[:, block]
        deviation = means[:, block] - mean
        inner = np.einsum("h,hij->ij", v, covariances[:, block, block])
        np.testing.assert_allclose(merged.mean[block], mean)
        np.testing.assert_allclose(
            merged.covariance[block, block], inner + (v[:, None] * deviation).T @ deviation
        )
    np.testing.assert_allclose(merged.existence, w @ existence)
    for track in range(3):
        weights = np.array([support[1 + c].sum() for c in range(4) if owner[c] == track])
        if weights.sum() > 0.0:
            np.testing.assert_allclose(
                merged.component_weight[owner == track], weights / weights.sum()
            )
    assert np.linalg.eigvalsh(merged.covariance)[0] > 0.0
    for one, other in itertools.combinations(range(5), 2):
        # Where some hypothesis supports both.
        together = bool((support[one] * support[other]).any())
        cross = merged.covariance[blocks[one], blocks[other]]
        assert cross.any() == (coupling == "joint" and together)


def test_judge_follows_bayes() -> None:
    rng = np.random.default_rng(3)
    state = replace(
        state_of(rng, [[1, 2], [2]]),
        existence=np.array([0.6, 0.9]),
        component_weight=np.array([0.7, 0.3, 1.0]),
    )
    _, fit = linear_problem(rng, state, np.ones((2, DIM), dtype=bool))
    fit = replace(fit, detection=np.array([0.9, 0.9, 0.5, 0.8]))
    track = np.array([[1, UNASSIGNED], [2, 0], [UNASSIGNED, UNASSIGNED]])
    source = np.array([[2, UNASSIGNED], [3, 0], [UNASSIGNED, UNASSIGNED]])
    outcomes = judge(
        alone(state, 2),
        fit,
        Hypotheses(track, source, np.full(3, 1 / 3), 0.0),
    )
    q = 0.7 * 0.1 + 0.3 * 0.5
    missed = np.array([0.6 * q / (0.4 + 0.6 * q), 0.9 * 0.2 / (0.1 + 0.9 * 0.2)])
    np.testing.assert_allclose(
        outcomes.existence, [[1.0, missed[1]], [missed[0], 1.0], missed], rtol=1e-12
    )
    left = np.array([0.7 * 0.1, 0.3 * 0.5]) / q
    np.testing.assert_allclose(
        outcomes.type_weight, [[0.0, 1.0, 1.0], [*left, 1.0], [*left, 1.0]], rtol=1e-12
    )


def births_of(rng: np.random.Generator, log_intensity: FloatArray) -> Births:
    count = log_intensity.shape[1]
    return Births(
        rng.normal(0.0, 50.0, (2, count, 3)),
        random_covariance(rng, 2, count, 3) + 20.0 * np.eye(3),
        rng.normal(0.0, 0.3, (2, count, 3, 4)),
        log_intensity,
    )


def test_augment_appends_births_correlated_through_the_vehicle() -> None:
    rng = np.random.default_rng(12)
    state = state_of(rng, [[1]])
    births = births_of(rng, np.log([[3e-9, 1e-30, 1e-9], [1e-9, 1e-30, 1e-30]]))
    new = np.log([8e-9, 5e-9, 2e-9])
    weights = LocalWeights(np.zeros((2, 3)), np.zeros((2, 3)), np.zeros(2), new)
    track = np.array([[UNASSIGNED, UNASSIGNED, UNASSIGNED], [UNASSIGNED, 0, 1]])
    ranked = Hypotheses(track, track, np.array([0.4, 0.6]), 0.0)
    born = newborn(births, weights, ranked, PARAMETERS)
    augmented = augment(state, *gaussian(state, len(track)), births, born, born.kept, PARAMETERS)
    after = augmented.state
    assert augmented.birth_track.tolist() == [1, UNASSIGNED, 2]
    assert after.track_id.tolist() == [1, 2, 3] and after.next_id == 4
    np.testing.assert_allclose(after.existence, [0.9, 0.5, 0.5])  # rho / (c + rho)
    assert after.component_type.tolist() == [1, 1, 2, 1]
    np.testing.assert_allclose(after.component_weight, [1.0, 0.75, 0.25, 1.0])
    # The old part is as it was; a new one follows the vehicle by its gain.
    np.testing.assert_array_equal(after.covariance[:7, :7], state.covariance)
    kept = [(0, 0), (1, 0), (0, 2)]
    to_position = after.position_jacobians[1:]
    gains = [to @ np.asarray(g) for to, g in zip(to_position, gains_of(after), strict=True)]
    for number, (kind, path) in enumerate(kept):
        block = slice(7 + 3 * number, 10 + 3 * number)
        np.testing.assert_allclose(gains[number], births.gain[kind, path], atol=1e-9)
        np.testing.assert_allclose(after.positions[1 + number], births.position[kind, path])
        np.testing.assert_allclose(
            after.position_covariances[1 + number], births.covariance[kind, path], atol=1e-8
        )
        for other in range(number):
            across = slice(7 + 3 * other, 10 + 3 * other)
            cross = to_position[number] @ after.covariance[block, across] @ to_position[other].T
            np.testing.assert_allclose(
                cross,
                births.gain[kind, path] @ state.ue_covariance @ births.gain[kept[other]].T,
                atol=1e-8,
            )
    np.testing.assert_allclose(after.covariance, after.covariance.T)


def gains_of(state: FilterState) -> list[FloatArray]:
    """How q of the components born follows the vehicle."""
    regression = np.linalg.solve(state.covariance[:7, :7], state.covariance[:7, 7:]).T
    np.testing.assert_allclose(regression[:, 4:], 0.0, atol=1e-9)  # the vehicle alone
    return list(regression[:, :4].reshape(-1, 3, 4))


def test_judge_lets_a_birth_live_only_where_its_path_is_free() -> None:
    rng = np.random.default_rng(12)
    state = state_of(rng, [[1]])
    births = births_of(rng, np.log([[1e-9, 1e-9], [1e-30, 1e-30]]))
    weights = LocalWeights(np.zeros((2, 2)), np.zeros((2, 2)), np.zeros(2), np.log([4e-9, 4e-9]))
    track = np.array([[UNASSIGNED, UNASSIGNED], [1, UNASSIGNED]])
    ranked = Hypotheses(track, track, np.array([0.5, 0.5]), 0.0)
    born = newborn(births, weights, ranked, PARAMETERS)
    augmented = augment(state, *gaussian(state, len(track)), births, born, born.kept, PARAMETERS)
    _, fit = linear_problem(rng, state, np.ones((2, DIM), dtype=bool))
    outcomes = judge(augmented, fit, ranked)
    np.testing.assert_allclose(outcomes.existence[:, 1:], [[0.25, 0.25], [0.0, 0.25]])


def test_prune_drops_tracks_and_types_and_keeps_the_rest_in_order() -> None:
    rng = np.random.default_rng(5)
    state = replace(
        state_of(rng, [[1, 2], [2], [1, 2]]),
        existence=np.array([0.9, 1e-6, 0.5]),
        component_weight=np.array([0.4, 0.6, 1.0, 1.0 - 1e-4, 1e-4]),
    )
    kept = prune(state, PARAMETERS)
    assert kept.track_id.tolist() == [1, 3]
    assert kept.component_track.tolist() == [0, 0, 1]
    assert kept.component_type.tolist() == [1, 2, 1]
    np.testing.assert_allclose(kept.component_weight, [0.4, 0.6, 1.0])
    index = [*range(10), 13, 14, 15]
    np.testing.assert_array_equal(kept.mean, state.mean[index])
    np.testing.assert_array_equal(kept.covariance, state.covariance[np.ix_(index, index)])


def test_prune_may_drop_everything() -> None:
    state = replace(state_of(np.random.default_rng(1), [[1], [2]]), existence=np.zeros(2))
    kept = prune(state, PARAMETERS)
    assert len(kept.track_id) == len(kept.component_track) == 0
    np.testing.assert_array_equal(kept.mean, state.mean[:4])
