"""Global hypotheses: every association of a small problem counted out as the witness."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest

from dopslam_ros.core.linalg.arrays import FloatArray
from dopslam_ros.core.linalg.jit import from_python
from dopslam_ros.core.models.measurements import MeasurementSet
from dopslam_ros.core.pmb import Density, FilterParameters, initial_density
from dopslam_ros.core.pmb import hypotheses as kernels
from dopslam_ros.core.pmb.birth import Births
from dopslam_ros.core.pmb.hypotheses import LOG_TINY, Hypotheses, LocalWeights
from dopslam_ros.core.pmb.likelihood import Likelihoods
from dopslam_ros.core.pmb.observed import prepare
from dopslam_ros.core.settings.layout import NONE

_associate = from_python(kernels.associate)
local_weights = from_python(kernels.local_weights)

PARAMETERS = FilterParameters(gamma=1000)


def associate(state: Density, weights: LocalWeights, parameters: FilterParameters) -> Hypotheses:
    """The associations that a step has."""
    return _associate(state.component_track, weights, parameters.gamma)


def state_of(tracks: list[int]) -> Density:
    """Tracks with so many components each; only the counts matter here."""
    owner = np.repeat(np.arange(len(tracks)), tracks)
    return initial_density(PARAMETERS).but(
        component_track=owner,
        track_id=np.arange(1, len(tracks) + 1),
    )


def weights_of(rng: np.random.Generator, tracks: list[int], paths: int) -> LocalWeights:
    owner = np.concatenate([[0], np.repeat(np.arange(len(tracks)), tracks) + 1])
    source = rng.normal(0.0, 1.5, (len(owner), paths))
    source[rng.random(source.shape) < 0.3] = -np.inf
    track = np.full((len(tracks) + 1, paths), -np.inf)
    np.logaddexp.at(track, owner, source)
    missed, new = rng.normal(-1.0, 1.0, len(tracks) + 1), rng.normal(-1.0, 1.0, paths)
    return LocalWeights(source, track, missed, new)


def every_association(weights: LocalWeights) -> dict[tuple[int, ...], float]:
    """Unnormalised weight of each, the product of what each path and each track says."""
    tracks, paths = weights.track.shape
    found = {}
    for choice in itertools.product(range(-1, tracks), repeat=paths):
        taken = [track for track in choice if track != NONE]
        if len(set(taken)) < len(taken):
            continue
        log_weight = sum(
            weights.new[path] if track == NONE else weights.track[track, path]
            for path, track in enumerate(choice)
        )
        log_weight += sum(weights.missed[t] for t in range(tracks) if t not in taken)
        if np.isfinite(log_weight):
            found[choice] = math.exp(log_weight)
    return found


@pytest.mark.parametrize("seed", range(15))
def test_all_associations_have_their_share(seed: int) -> None:
    rng = np.random.default_rng(seed)
    tracks, paths = [1] * int(rng.integers(0, 3)), int(rng.integers(1, 4))
    weights = weights_of(rng, tracks, paths)
    association = associate(state_of(tracks), weights, PARAMETERS)
    truth = every_association(weights)
    total = sum(truth.values())
    assert len(association.weight) == len(truth)
    for columns, weight in zip(association.track.tolist(), association.weight, strict=True):
        assert weight == pytest.approx(truth[tuple(columns)] / total, rel=1e-9)
    assert np.all(np.diff(association.weight) <= 1e-12)
    assert association.weight.sum() == pytest.approx(1.0)
    np.testing.assert_array_equal(association.track, association.source)  # one component per track


@pytest.mark.parametrize("seed", range(10))
def test_landmarks_of_open_type_split_an_association_by_type(seed: int) -> None:
    rng = np.random.default_rng(seed)
    tracks = [2, 1, 2]
    weights = weights_of(rng, tracks, 3)
    association = associate(state_of(tracks), weights, PARAMETERS)
    truth = every_association(weights)
    total = sum(truth.values())
    owner = np.array([0, 1, 1, 2, 3, 3])
    summed: dict[tuple[int, ...], float] = {}
    for columns, sources, weight in zip(
        association.track, association.source, association.weight, strict=True
    ):
        given = sources != NONE
        np.testing.assert_array_equal(owner[sources[given]], columns[given])
        assert np.all(columns[~given] == NONE)
        share = np.exp(
            weights.source[sources[given], np.flatnonzero(given)]
            - weights.track[columns[given], np.flatnonzero(given)]
        ).prod()
        key = tuple(columns.tolist())
        assert weight == pytest.approx(truth[key] * share / total, rel=0.02)
        summed[key] = summed.get(key, 0.0) + float(weight)
    for key, weight in truth.items():
        assert summed[key] == pytest.approx(weight / total, rel=0.02, abs=1e-6)


@pytest.mark.parametrize("gamma", [1, 3, 10])
def test_no_more_than_gamma_are_kept_and_those_are_the_best(gamma: int) -> None:
    rng = np.random.default_rng(1)
    weights = weights_of(rng, [1, 1], 3)
    few = associate(state_of([1, 1]), weights, replace(PARAMETERS, gamma=gamma))
    many = associate(state_of([1, 1]), weights, PARAMETERS)
    kept = min(gamma, len(many.weight))
    assert len(few.weight) == kept
    np.testing.assert_array_equal(few.track, many.track[:kept])
    np.testing.assert_allclose(few.weight, many.weight[:kept] / many.weight[:kept].sum())


@pytest.mark.parametrize("gamma", [1, 2, 5, 12, 40])
def test_of_the_best_associations_the_likeliest_types_are_kept(gamma: int) -> None:
    for seed in range(10):
        weights = weights_of(np.random.default_rng(seed), [2, 2, 1], 3)
        few = associate(state_of([2, 2, 1]), weights, replace(PARAMETERS, gamma=gamma))
        many = associate(state_of([2, 2, 1]), weights, PARAMETERS)
        truth = every_association(weights)
        best = set(sorted(truth, key=lambda choice: -truth[choice])[:gamma])
        split = [h for h, track in enumerate(many.track.tolist()) if tuple(track) in best][:gamma]
        np.testing.assert_array_equal(few.source, many.source[split])
        np.testing.assert_array_equal(few.track, many.track[split])
        share = many.weight[split].sum()
        np.testing.assert_allclose(few.weight, many.weight[split] / share)
        assert few.log_evidence == pytest.approx(many.log_evidence + math.log(share))


def open_types(shares: list[float]) -> tuple[Density, LocalWeights]:
    """As many tracks as paths, path j surely from track j, whose second type has a given share."""
    count = len(shares)
    source = np.full((2 * count + 1, count), -np.inf)
    for path, share in enumerate(shares):
        source[2 * path + 1 : 2 * path + 3, path] = np.log([1.0 - share, share])
    track = np.full((count + 1, count), -np.inf)
    np.fill_diagonal(track[1:], 0.0)
    impossible = np.full(count, -100.0)
    return state_of([2] * count), LocalWeights(source, track, np.zeros(count + 1), impossible)


def test_the_least_clear_types_split_and_the_others_are_the_likeliest() -> None:
    shares = [0.01, 0.4, 0.3, 0.02, 0.45, 0.2]
    state, weights = open_types(shares)
    association = associate(state, weights, replace(PARAMETERS, gamma=16))
    second = association.source - 2 * np.arange(6) - 1
    assert set(second.ravel().tolist()) == {0, 1}
    np.testing.assert_array_equal(second.any(axis=0), [False, True, True, False, True, True])
    assert len(np.unique(second, axis=0)) == 16
    expected = np.prod(np.where(second[:, [1, 2, 4, 5]], [0.4, 0.3, 0.45, 0.2], 1.0), axis=1)
    expected *= np.prod(np.where(second[:, [1, 2, 4, 5]], 1.0, [0.6, 0.7, 0.55, 0.8]), axis=1)
    np.testing.assert_allclose(association.weight, np.sort(expected)[::-1])
    np.testing.assert_allclose(association.weight, expected)


def test_a_type_with_next_to_no_share_gets_no_hypothesis() -> None:
    state, weights = open_types([0.9e-3, 1.1e-3])
    association = associate(state, weights, replace(PARAMETERS, gamma=4))
    paths_given = association.source[(association.track == [1, 2]).all(axis=1)]
    np.testing.assert_array_equal(paths_given, [[1, 3], [1, 4]])


def test_local_weights_of_what_is_sure_or_impossible() -> None:
    state = state_of([1, 2, 1]).but(
        existence=np.array([0.0, 1.0, 0.5]),
        component_weight=np.array([1.0, 1.0, 0.0, 1.0]),
    )
    paths = MeasurementSet(np.zeros((2, 6)), np.zeros((2, 6, 6)))
    observed = prepare(paths, replace(PARAMETERS, clutter_mean=0.0))
    log_likelihood = np.array([[0.0, -np.inf]] * 5)
    fit = Likelihoods(
        np.zeros((5, 6, 4)),
        np.zeros((5, 6, 3)),
        np.array([1.0, 0.9, 1.0, 0.9, 0.0]),
        np.zeros((5, 2, 6)),
        log_likelihood,
    )
    none = Births(
        np.zeros((2, 2, 3)),
        np.zeros((2, 2, 3, 3)),
        np.zeros((2, 2, 3, 4)),
        np.full((2, 2), -np.inf),
    )
    constants = replace(PARAMETERS, clutter_mean=0.0).constants
    weights = local_weights(state, observed, fit, none, constants)
    np.testing.assert_array_equal(weights.missed, [LOG_TINY, 0.0, LOG_TINY, 0.0])
    np.testing.assert_array_equal(weights.new, [LOG_TINY, LOG_TINY])
    np.testing.assert_array_equal(weights.source[:, 0], [0.0, -np.inf, 0.0, -np.inf, -np.inf])
    np.testing.assert_array_equal(weights.track[:, 0], [0.0, -np.inf, 0.0, -np.inf])
    assert np.all(weights.source[:, 1] == -np.inf) and np.all(weights.track[:, 1] == -np.inf)
    association = associate(state, weights, PARAMETERS)
    assert np.isfinite(association.weight).all() and association.weight.sum() == pytest.approx(1.0)


def test_no_paths_is_one_hypothesis() -> None:
    weights = weights_of(np.random.default_rng(0), [1, 2], 0)
    association = associate(state_of([1, 2]), weights, PARAMETERS)
    assert association.track.shape == association.source.shape == (1, 0)
    assert association.weight.tolist() == [1.0]


def extreme(value: float) -> FloatArray:
    return np.array([[value, -value]])


@pytest.mark.parametrize("value", [600.0, -600.0, 0.0])
def test_extreme_weights_do_not_overflow(value: float) -> None:
    weights = LocalWeights(
        extreme(value), extreme(value), np.array([-700.0]), np.array([-700.0, -700.0])
    )
    association = associate(state_of([]), weights, PARAMETERS)
    assert np.isfinite(association.weight).all() and association.weight.sum() == pytest.approx(1.0)
