"""The k best assignments: every possible one counted out as a witness."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from dopslam_ros.core.arrays import FloatArray
from dopslam_ros.core.assignment import UNASSIGNED, clusters, k_best_assignments


def every_assignment(cost: FloatArray, idle_cost: FloatArray) -> dict[tuple[int, ...], float]:
    """Cost of each possible assignment by its columns."""
    rows, columns = cost.shape
    found = {}
    for choice in itertools.product(range(-1, columns), repeat=rows):
        taken = [column for column in choice if column != UNASSIGNED]
        if len(set(taken)) < len(taken):
            continue
        parts = [
            idle_cost[row] if column == UNASSIGNED else cost[row, column]
            for row, column in enumerate(choice)
        ]
        if np.isfinite(parts).all():
            found[choice] = float(sum(parts))
    return found


def check(cost: FloatArray, idle_cost: FloatArray, k: int) -> None:
    """What came out is the k cheapest of all, in order, each once, with its cost."""
    truth = every_assignment(cost, idle_cost)
    ranked = k_best_assignments(cost, idle_cost, k)
    assert ranked.columns.shape == (len(ranked.costs), len(cost))
    best = sorted(truth.values())[:k]
    np.testing.assert_allclose(ranked.costs, best, atol=1e-9)
    assert np.all(np.diff(ranked.costs) >= -1e-9)
    chosen = [tuple(columns) for columns in ranked.columns.tolist()]
    assert len(set(chosen)) == len(chosen)
    for columns, total in zip(chosen, ranked.costs, strict=True):
        assert truth[columns] == pytest.approx(total, abs=1e-9)


def problem(
    seed: int, ties: bool, gated: float, forced: float
) -> tuple[FloatArray, FloatArray, int]:
    rng = np.random.default_rng(seed)
    rows, columns = rng.integers(0, 5), rng.integers(0, 6)
    cost = rng.normal(0.0, 5.0, (rows, columns))
    idle = rng.normal(0.0, 5.0, rows)
    if ties:
        cost, idle = np.round(cost / 4.0), np.round(idle / 4.0)
    cost[rng.random(cost.shape) < gated] = np.inf
    idle[rng.random(rows) < forced] = np.inf
    return cost, idle, int(rng.integers(1, 40))


@pytest.mark.parametrize("seed", range(60))
def test_against_counting(seed: int) -> None:
    check(*problem(seed, ties=False, gated=0.0, forced=0.0))


@pytest.mark.parametrize("seed", range(60))
def test_against_counting_with_gates(seed: int) -> None:
    check(*problem(seed, ties=False, gated=0.5, forced=0.0))


@pytest.mark.parametrize("seed", range(60))
def test_against_counting_with_ties_and_rows_that_must_not_idle(seed: int) -> None:
    check(*problem(seed, ties=True, gated=0.3, forced=0.4))


def test_more_asked_for_than_there_is() -> None:
    rng = np.random.default_rng(5)
    cost, idle = rng.normal(size=(3, 4)), rng.normal(size=3)
    everything = every_assignment(cost, idle)
    ranked = k_best_assignments(cost, idle, 10_000)
    assert {tuple(c) for c in ranked.columns.tolist()} == set(everything)


def test_nothing_to_assign_is_one_assignment() -> None:
    ranked = k_best_assignments(np.zeros((0, 3)), np.zeros(0), 5)
    assert ranked.columns.shape == (1, 0) and ranked.costs.tolist() == [0.0]


def test_no_columns_leaves_all_idle() -> None:
    ranked = k_best_assignments(np.zeros((3, 0)), np.array([1.0, 2.0, 4.0]), 5)
    assert ranked.columns.tolist() == [[UNASSIGNED] * 3] and ranked.costs.tolist() == [7.0]


def test_impossible_problems_have_no_assignment() -> None:
    # Two rows must have the only column.
    ranked = k_best_assignments(np.zeros((2, 1)), np.full(2, np.inf), 3)
    assert ranked.columns.shape == (0, 2) and len(ranked.costs) == 0
    # A row may neither idle nor take anything.
    ranked = k_best_assignments(np.array([[np.inf], [1.0]]), np.array([np.inf, 0.0]), 3)
    assert len(ranked.costs) == 0


def test_rows_without_columns_do_not_disturb_the_ranking() -> None:
    cost = np.array([[1.0, np.inf], [np.inf, np.inf], [np.inf, 2.0]])
    check(cost, np.array([5.0, 3.0, 1.0]), 10)


def test_clusters_are_found_and_ranked_as_one_problem() -> None:
    rng = np.random.default_rng(8)
    cost = np.full((4, 5), np.inf)
    cost[np.ix_([0, 2], [1, 3])] = rng.normal(size=(2, 2))
    cost[np.ix_([1, 3], [0, 4])] = rng.normal(size=(2, 2))
    parts = clusters(np.isfinite(cost))
    assert [(r.tolist(), c.tolist()) for r, c in parts] == [([0, 2], [1, 3]), ([1, 3], [0, 4])]
    idle = rng.normal(size=4)
    for k in (1, 3, 7, 100):
        check(cost, idle, k)


def test_clusters_against_the_same_problem_made_dense() -> None:
    # A cost that nobody pays instead of infinity: one cluster, the same best solutions.
    for seed in range(20):
        rng = np.random.default_rng(seed)
        cost, idle = rng.normal(size=(5, 6)), rng.normal(size=5)
        gate = rng.random(cost.shape) < 0.6
        sparse, dense = np.where(gate, np.inf, cost), np.where(gate, 1e6, cost)
        assert len(clusters(np.isfinite(dense))) == 1
        one, other = k_best_assignments(sparse, idle, 12), k_best_assignments(dense, idle, 12)
        np.testing.assert_allclose(one.costs, other.costs[: len(one.costs)], atol=1e-6)
        np.testing.assert_array_equal(one.columns, other.columns[: len(one.columns)])


def test_the_problem_is_left_as_it_was() -> None:
    cost, idle = np.arange(6.0).reshape(2, 3), np.ones(2)
    k_best_assignments(cost, idle, 5)
    np.testing.assert_array_equal(cost, np.arange(6.0).reshape(2, 3))
    np.testing.assert_array_equal(idle, np.ones(2))
