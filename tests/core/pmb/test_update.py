"""The Gaussian update: the linear Kalman filter and mixture moments as witnesses."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag

from dopslam_ros.core.linalg.arrays import BoolArray, FloatArray, IntArray
from dopslam_ros.core.linalg.jit import from_python
from dopslam_ros.core.pmb import Density, FilterParameters, initial_density
from dopslam_ros.core.pmb import merge as merge_kernels
from dopslam_ros.core.pmb import newborn as newborn_kernels
from dopslam_ros.core.pmb import update as update_kernels
from dopslam_ros.core.pmb.birth import Births
from dopslam_ros.core.pmb.coordinates import frames, jacobians
from dopslam_ros.core.pmb.coordinates_kernels import components_in_space
from dopslam_ros.core.pmb.hypotheses import Hypotheses
from dopslam_ros.core.pmb.likelihood import Likelihoods, Observed
from dopslam_ros.core.pmb.merge import Conditioned
from dopslam_ros.core.pmb.update import Linearised, Updated
from dopslam_ros.core.settings.layout import DIM, NONE

existence_and_types = from_python(merge_kernels.existence_and_types)
merge = from_python(merge_kernels.merge)
augment = from_python(newborn_kernels.augment)
newborn = from_python(newborn_kernels.newborn)
_condition = from_python(update_kernels.condition)

PARAMETERS = FilterParameters()
# What no hypothesis supports goes all the same.
UNPRUNED = FilterParameters(prune_existence=0.0, prune_type=0.0)


def condition(state: Density, fit: Likelihoods, observed: Observed, source: IntArray) -> Updated:
    """The update of a density about its mean."""
    about = Linearised(state.mean, state.vehicle, state.start, fit, observed)
    return _condition(about, state.covariance, source)


def random_covariance(rng: np.random.Generator, *shape: int) -> FloatArray:
    root = rng.normal(size=(*shape, shape[-1]))
    return root @ np.swapaxes(root, -1, -2) + 0.5 * np.eye(shape[-1])


def state_of(rng: np.random.Generator, tracks: list[list[int]], existence: float = 0.9) -> Density:
    """A random density; ``tracks`` has the types of each track's components."""
    kinds = [kind for track in tracks for kind in track]
    owner = [number for number, track in enumerate(tracks) for _ in track]
    n = 4 + 3 * len(kinds)
    return initial_density(PARAMETERS).but(
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
    rng: np.random.Generator, state: Density, used: BoolArray
) -> tuple[Observed, Likelihoods]:
    """Paths of a linear model: z = A_i s + B_i q_i + noise."""
    sources, count = len(state.component_track) + 1, len(used)
    a = rng.normal(size=(sources, DIM, 4))
    b = rng.normal(size=(sources, DIM, 3))
    b[0] = 0.0
    h = a @ state.ue_mean
    h[1:] += np.einsum("mij,mj->mi", b[1:], state.mean[4:].reshape(-1, 3))
    z = rng.normal(0.0, 5.0, (count, DIM))
    both = used[:, :, None] & used[:, None, :]
    noise = np.where(both, random_covariance(rng, count, DIM), np.eye(DIM))
    innovation = np.where(used, z - h[:, None, :], 0.0)
    fit = Likelihoods(
        ue_jacobian=a,
        landmark_jacobian=b,
        detection=np.full(sources, 0.9),
        innovation=innovation,
        log_likelihood=np.zeros((sources, count)),
    )
    return Observed(np.where(used, z, np.nan), used, noise), fit


def kalman(
    state: Density, observed: Observed, fit: Likelihoods, source: list[int]
) -> tuple[FloatArray, FloatArray]:
    """The textbook update in information form, one row of H per component that was measured."""
    information = np.linalg.inv(state.covariance)
    vector = information @ state.mean
    for path, i in enumerate(source):
        if i == NONE:
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


def joint_nis(state: Density, observed: Observed, fit: Likelihoods, source: list[int]) -> float:
    """v' S^-1 v with all rows of H, and so all of S, in one piece."""
    rows, noises, innovations = [np.zeros((0, len(state.mean)))], [], [np.zeros(0)]
    for path, i in enumerate(source):
        if i == NONE:
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
    source = [[0, 3, NONE, 2], [NONE, 4, 1, 3], [NONE] * 4, [0, 1, 3, 4]]
    updated = condition(state, fit, observed, np.array(source))
    assert updated.definite
    for row, sources in enumerate(source):
        mean, covariance = kalman(state, observed, fit, sources)
        found = covariance_under(updated, row)
        np.testing.assert_allclose(updated.means[row], mean, rtol=1e-8, atol=1e-8)
        np.testing.assert_allclose(found, covariance, rtol=1e-8, atol=1e-8)
        assert np.linalg.eigvalsh(found)[0] > 0.0
        nis = joint_nis(state, observed, fit, sources)
        assert updated.nis[row] == pytest.approx(nis, rel=1e-8)


def covariance_under(updated: Updated, row: int) -> FloatArray:
    """The covariance that a hypothesis has: less W'W of every branch on its way."""
    at, covariance = updated.rank[row], updated.covariance.copy()
    for first, last, gain in zip(updated.first, updated.last, updated.gains, strict=True):
        if first <= at < last:
            covariance -= gain.T @ gain
    return covariance


@pytest.mark.parametrize("seed", range(6))
def test_what_hypotheses_share_is_counted_once_each(seed: int) -> None:
    """Many that differ here and there, more paths than are worked in at a time."""
    rng = np.random.default_rng(seed)
    state = state_of(rng, [[1, 2], *([[2]] * 12)])
    observed, fit = linear_problem(rng, state, rng.random((16, DIM)) < 0.8)
    best = np.append(rng.permutation(15), NONE)[:16]
    source = np.repeat(best[None], 9, 0)
    for row in range(1, 9):
        for path in rng.choice(4 if seed % 2 else 16, 1 + row % 3, replace=False):
            source[row, path] = NONE
    updated = condition(state, fit, observed, source)
    for row, sources in enumerate(source.tolist()):
        mean, covariance = kalman(state, observed, fit, sources)
        scale = np.sqrt(np.diag(covariance))
        np.testing.assert_allclose((updated.means[row] - mean) / scale, 0.0, atol=1e-7)
        difference = (covariance_under(updated, row) - covariance) / np.outer(scale, scale)
        np.testing.assert_allclose(difference, 0.0, atol=1e-7)
    assert len(updated.gains) < 9 * 16 / 2


def test_condition_with_one_hypothesis_only() -> None:
    rng = np.random.default_rng(30)
    state = state_of(rng, [[2]])
    observed, fit = linear_problem(rng, state, np.ones((2, DIM), dtype=bool))
    updated = condition(state, fit, observed, np.array([[1, 0]]))
    mean, covariance = kalman(state, observed, fit, [1, 0])
    np.testing.assert_allclose(updated.means[0], mean, rtol=1e-8)
    assert len(updated.gains) == 0
    np.testing.assert_allclose(updated.covariance, covariance, rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("paths", [0, 2])
def test_condition_without_any_assignment_is_the_prediction(paths: int) -> None:
    rng = np.random.default_rng(31)
    state = state_of(rng, [[2]])
    observed, fit = linear_problem(rng, state, np.ones((paths, DIM), dtype=bool))
    source = np.full((1, paths), NONE)
    updated = condition(state, fit, observed, source)
    np.testing.assert_allclose(updated.means[0], state.mean, rtol=1e-12)
    np.testing.assert_allclose(updated.covariance, state.covariance, rtol=1e-12)
    assert updated.nis.tolist() == [0.0]


def test_condition_says_where_a_covariance_is_not_positive_definite() -> None:
    rng = np.random.default_rng(32)
    state = state_of(rng, [[2]])
    observed, fit = linear_problem(rng, state, np.ones((1, DIM), dtype=bool))
    for source in ([[1]], [[1], [0]]):
        broken = condition(state.but(covariance=-state.covariance), fit, observed, np.array(source))
        assert not broken.definite


def mixture(
    rng: np.random.Generator, tracks: list[list[int]], hypotheses: int
) -> tuple[Density, Updated, FloatArray, FloatArray]:
    """A density under each of some hypotheses of random weight, with the covariances (H, n, n).

    Each has a branch of its own.
    """
    state = state_of(rng, tracks)
    n = len(state.mean)
    means = state.mean + rng.normal(0.0, 1.0, (hypotheses, n))
    gains = rng.normal(0.0, 0.5, (hypotheses, DIM, n))
    taken = np.swapaxes(gains, 1, 2) @ gains
    common = taken.sum(axis=0) + random_covariance(rng, n)
    place = rng.permutation(hypotheses)
    updated = Updated(
        common, means, np.ones(hypotheses), place, place.copy(), place + 1, gains, True
    )
    return state, updated, common - taken, rng.dirichlet(np.ones(hypotheses))


def merged_of(
    state: Density,
    updated: Updated,
    existence: FloatArray,
    type_weight: FloatArray,
    weight: FloatArray,
    parameters: FilterParameters = UNPRUNED,
) -> Density:
    none = np.zeros(0, dtype=np.int64)
    conditioned = Conditioned(state, none, updated, existence, type_weight)
    return merge(weight, conditioned, parameters.constants)


@pytest.mark.parametrize("seed", range(5))
def test_merge_of_sure_landmarks_has_the_moments_of_the_mixture(seed: int) -> None:
    rng = np.random.default_rng(seed)
    state, updated, covariances, w = mixture(rng, [[1], [2]], 4)
    merged = merged_of(state, updated, np.ones((4, 2)), np.ones((4, 2)), w)
    means = updated.means
    mean = w @ means
    second = sum(w[h] * (covariances[h] + np.outer(means[h], means[h])) for h in range(4))
    np.testing.assert_allclose(merged.mean, mean)
    np.testing.assert_allclose(merged.covariance, second - np.outer(mean, mean), atol=1e-10)
    np.testing.assert_allclose(merged.existence, 1.0)


def test_merge_against_sampling() -> None:
    rng = np.random.default_rng(9)
    state, updated, covariances, weight = mixture(rng, [[2]], 3)
    merged = merged_of(state, updated, np.ones((3, 1)), np.ones((3, 1)), weight)
    means = updated.means
    which = rng.choice(3, 60_000, p=weight)
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
    state, updated, covariances, w = mixture(rng, [[1, 2], [2], [1]], 5)
    means = updated.means
    existence = rng.random((5, 3))
    existence[rng.random((5, 3)) < 0.3] = 0.0
    share = rng.random(5)
    existence[int(rng.integers(5))] = 1.0  # each is supported by one at least
    types = np.stack([share, 1.0 - share, np.ones(5), np.ones(5)], 1)
    parameters = replace(UNPRUNED, coupling=coupling)
    merged = merged_of(state, updated, existence, types, w, parameters)

    owner = state.component_track
    blocks = [slice(0, 4), *(slice(4 + 3 * c, 7 + 3 * c) for c in range(4))]
    support = [w, *(w * existence[:, owner[c]] * types[:, c] for c in range(4))]
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


def test_existence_and_types_follow_bayes() -> None:
    rng = np.random.default_rng(3)
    state = state_of(rng, [[1, 2], [2]]).but(
        existence=np.array([0.6, 0.9]),
        component_weight=np.array([0.7, 0.3, 1.0]),
    )
    detection = np.array([0.9, 0.9, 0.5, 0.8])
    source = np.array([[2, NONE], [3, 0], [NONE, NONE]])
    existence, types = existence_and_types(state, detection, np.full(2, NONE), source)
    q = 0.7 * 0.1 + 0.3 * 0.5
    missed = np.array([0.6 * q / (0.4 + 0.6 * q), 0.9 * 0.2 / (0.1 + 0.9 * 0.2)])
    np.testing.assert_allclose(existence, [[1.0, missed[1]], [missed[0], 1.0], missed], rtol=1e-12)
    left = np.array([0.7 * 0.1, 0.3 * 0.5]) / q
    np.testing.assert_allclose(types, [[0.0, 1.0, 1.0], [*left, 1.0], [*left, 1.0]], rtol=1e-12)


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
    track = np.array([[NONE, NONE, NONE], [NONE, 0, 1]])
    association = Hypotheses(track, track, np.array([0.4, 0.6]), 0.0)
    born = newborn(births.log_intensity, new, association, PARAMETERS.prune_existence)
    after, birth_track = augment(state, births, born, born.kept, PARAMETERS.constants)
    position, covariance = components_in_space(after)
    assert birth_track.tolist() == [1, NONE, 2]
    assert after.track_id.tolist() == [1, 2, 3] and after.next_id == 4
    np.testing.assert_allclose(after.existence, [0.9, 0.5, 0.5])  # rho / (c + rho)
    assert after.component_type.tolist() == [1, 1, 2, 1]
    np.testing.assert_allclose(after.component_weight, [1.0, 0.75, 0.25, 1.0])
    # The old part is as it was; a new one follows the vehicle by its gain.
    np.testing.assert_array_equal(after.covariance[:7, :7], state.covariance)
    kept = [(0, 0), (1, 0), (0, 2)]
    to_position = jacobians(after.axes, after.mean[4:].reshape(-1, 3))[1:]
    gains = [to @ np.asarray(g) for to, g in zip(to_position, gains_of(after), strict=True)]
    for number, (kind, path) in enumerate(kept):
        block = slice(7 + 3 * number, 10 + 3 * number)
        np.testing.assert_allclose(gains[number], births.gain[kind, path], atol=1e-9)
        np.testing.assert_allclose(position[1 + number], births.position[kind, path])
        np.testing.assert_allclose(covariance[1 + number], births.covariance[kind, path], atol=1e-8)
        for other in range(number):
            across = slice(7 + 3 * other, 10 + 3 * other)
            cross = to_position[number] @ after.covariance[block, across] @ to_position[other].T
            np.testing.assert_allclose(
                cross,
                births.gain[kind, path] @ state.ue_covariance @ births.gain[kept[other]].T,
                atol=1e-8,
            )
    np.testing.assert_allclose(after.covariance, after.covariance.T)


def gains_of(state: Density) -> list[FloatArray]:
    """How q of the components born follows the vehicle."""
    regression = np.linalg.solve(state.covariance[:7, :7], state.covariance[:7, 7:]).T
    np.testing.assert_allclose(regression[:, 4:], 0.0, atol=1e-9)  # the vehicle alone
    return list(regression[:, :4].reshape(-1, 3, 4))


def test_a_birth_exists_only_where_its_path_is_free() -> None:
    rng = np.random.default_rng(12)
    state = state_of(rng, [[1]])
    births = births_of(rng, np.log([[1e-9, 1e-9], [1e-30, 1e-30]]))
    new = np.log([4e-9, 4e-9])
    track = np.array([[NONE, NONE], [1, NONE]])
    association = Hypotheses(track, track, np.array([0.5, 0.5]), 0.0)
    born = newborn(births.log_intensity, new, association, PARAMETERS.prune_existence)
    density, birth_track = augment(state, births, born, born.kept, PARAMETERS.constants)
    existence, _ = existence_and_types(density, np.full(2, 0.9), birth_track, track)
    np.testing.assert_allclose(existence[:, 1:], [[0.25, 0.25], [0.0, 0.25]])


def alone(state: Density, share: FloatArray, existence: FloatArray) -> Density:
    """What is kept where there is one hypothesis, with the defaults."""
    n = len(state.mean)
    none = np.zeros(0, dtype=np.int64)
    updated = Updated(
        state.covariance,
        state.mean[None],
        np.zeros(1),
        np.zeros(1, np.int64),
        none,
        none,
        np.zeros((0, DIM, n)),
        True,
    )
    return merged_of(state, updated, existence[None], share[None], np.ones(1), PARAMETERS)


def test_unlikely_tracks_and_types_go_and_the_rest_stays_in_order() -> None:
    rng = np.random.default_rng(5)
    state = state_of(rng, [[1, 2], [2], [1, 2]])
    share = np.array([0.4, 0.6, 1.0, 1.0 - 1e-4, 1e-4])
    kept = alone(state, share, np.array([0.9, 1e-6, 0.5]))
    assert kept.track_id.tolist() == [1, 3]
    assert kept.component_track.tolist() == [0, 0, 1]
    assert kept.component_type.tolist() == [1, 2, 1]
    np.testing.assert_allclose(kept.component_weight, [0.4, 0.6, 1.0])
    index = [*range(10), 13, 14, 15]
    np.testing.assert_array_equal(kept.mean, state.mean[index])
    np.testing.assert_array_equal(kept.covariance, state.covariance[np.ix_(index, index)])
    np.testing.assert_array_equal(kept.axes, state.axes[[0, 1, 3]])
    np.testing.assert_array_equal(kept.origin, state.origin[[0, 1, 3]])


def test_everything_may_go() -> None:
    state = state_of(np.random.default_rng(1), [[1], [2]])
    kept = alone(state, np.ones(2), np.zeros(2))
    assert len(kept.track_id) == len(kept.component_track) == 0
    np.testing.assert_array_equal(kept.mean, state.mean[:4])
