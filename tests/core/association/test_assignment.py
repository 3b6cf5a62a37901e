"""The k best assignments: every possible one counted out as a witness."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from dopslam_ros.core.association.assignment import k_best_assignments
from dopslam_ros.core.association.clusters import cluster_heads
from dopslam_ros.core.association.shortest_path import sparse as sparse_problem
from dopslam_ros.core.linalg.arrays import FloatArray
from dopslam_ros.core.settings.layout import NONE


def every_assignment(cost: FloatArray, idle_cost: FloatArray) -> dict[tuple[int, ...], float]:
    """Cost of each possible assignment by its columns."""
    rows, columns = cost.shape
    found = {}
    for choice in itertools.product(range(-1, columns), repeat=rows):
        taken = [column for column in choice if column != NONE]
        if len(set(taken)) < len(taken):
            continue
        parts = [
            idle_cost[row] if column == NONE else cost[row, column]
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
    np.testing.assert_allclose(ranked.costs, best, rtol=1e-12, atol=1e-9)
    assert np.all(np.diff(ranked.costs) >= 0.0)
    chosen = [tuple(columns) for columns in ranked.columns.tolist()]
    assert len(set(chosen)) == len(chosen)
    for columns, total in zip(chosen, ranked.costs, strict=True):
        assert truth[columns] == pytest.approx(total, rel=1e-12, abs=1e-9)


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


@pytest.mark.parametrize("seed", range(40))
def test_against_counting_with_numbers_of_any_size_and_none(seed: int) -> None:
    # What is not finite is ruled out, whatever it is; a large number is a cost like another.
    rng = np.random.default_rng(seed)
    rows, columns = (int(n) for n in rng.integers([1, 0], [5, 5]))
    cost = rng.normal(size=(rows, columns)) * 10.0 ** rng.integers(-6, 13, (rows, columns))
    idle = rng.normal(size=rows) * 10.0 ** rng.integers(-6, 13, rows)
    for gap in (np.inf, -np.inf, np.nan):
        cost[rng.random(cost.shape) < 0.15] = gap
        idle[rng.random(rows) < 0.1] = gap
    truth = every_assignment(cost, idle)
    ranked = k_best_assignments(cost, idle, 30)
    best = np.sort(list(truth.values()))[:30]
    size = max(1.0, np.abs([*cost[np.isfinite(cost)], *idle[np.isfinite(idle)]]).sum())
    np.testing.assert_allclose(ranked.costs, best, atol=1e-14 * size)
    assert len({tuple(columns) for columns in ranked.columns.tolist()}) == len(best)


@pytest.mark.parametrize("size", [1e100, 1e300, 1.7e308])
def test_huge_costs_never_give_nan(size: float) -> None:
    for seed in range(50):
        cost, idle, k = problem(seed, ties=False, gated=0.3, forced=0.2)
        ranked = k_best_assignments(np.tanh(cost) * size, np.tanh(idle) * size, k)
        assert not np.isnan(ranked.costs).any()


def test_a_single_row_ranks_its_columns() -> None:
    rng = np.random.default_rng(2)
    cost, idle = rng.normal(size=(1, 30)), rng.normal(size=1)
    ranked = k_best_assignments(cost, idle, 100)
    every = np.append(cost[0], idle)
    np.testing.assert_array_equal(ranked.costs, np.sort(every))
    order = np.argsort(every)
    np.testing.assert_array_equal(ranked.columns[:, 0], np.where(order < 30, order, NONE))


def test_ties_come_out_the_same_every_time() -> None:
    for k in (1, 5, 20, 1000):
        first = k_best_assignments(np.zeros((4, 5)), np.zeros(4), k)
        again = k_best_assignments(np.zeros((4, 5)), np.zeros(4), k)
        np.testing.assert_array_equal(first.columns, again.columns)
        check(np.zeros((4, 5)), np.zeros(4), k)


def large_problem(seed: int) -> tuple[FloatArray, FloatArray]:
    """60 rows that compete for 50 columns, three candidates each."""
    rng = np.random.default_rng(seed)
    cost = np.full((60, 50), np.inf)
    for row in cost:
        row[rng.choice(50, 3, replace=False)] = rng.normal(-5.0, 5.0, 3)
    return cost, rng.normal(0.0, 3.0, 60)


def cheapest(cost: FloatArray, idle: FloatArray) -> float:
    """What SciPy pays for a problem in which every row has an idle column of its own."""
    own = np.full((len(cost), len(cost)), np.inf)
    np.fill_diagonal(own, idle)
    square = np.hstack([cost, own])
    return float(square[linear_sum_assignment(square)].sum())


@pytest.mark.parametrize("seed", range(5))
def test_large_problems_against_scipy(seed: int) -> None:
    cost, idle = large_problem(seed)
    ranked = k_best_assignments(cost, idle, 40)
    assert ranked.costs[0] == pytest.approx(cheapest(cost, idle))
    # The second differs from the first in some row; the best of each such kind is SciPy's.
    others = []
    for row, column in enumerate(ranked.columns[0].tolist()):
        without, without_idle = cost.copy(), idle.copy()
        (without_idle if column == NONE else without[row])[row if column == NONE else column] = (
            np.inf
        )
        others.append(cheapest(without, without_idle))
    assert ranked.costs[1] == pytest.approx(min(others))
    # All are possible, differ, and cost what they say.
    assert len({tuple(columns) for columns in ranked.columns.tolist()}) == 40
    for columns, total in zip(ranked.columns, ranked.costs, strict=True):
        given = np.flatnonzero(columns != NONE)
        assert len(set(columns[given].tolist())) == len(given)
        paid = cost[given, columns[given]].sum() + idle[columns == NONE].sum()
        assert total == pytest.approx(paid)


def test_few_are_the_first_of_many() -> None:
    cost, idle = large_problem(9)
    many = k_best_assignments(cost, idle, 200)
    for k in (1, 2, 10, 50):
        few = k_best_assignments(cost, idle, k)
        np.testing.assert_allclose(few.costs, many.costs[:k], atol=1e-9)


def test_any_kind_of_array_will_do() -> None:
    cost, idle = np.arange(6).reshape(2, 3), np.array([4, 5])
    plain = k_best_assignments(cost.astype(float), idle.astype(float), 7)
    fixed = np.asfortranarray(cost, dtype=float)
    fixed.setflags(write=False)
    for other in (cost, cost.astype(np.float32), fixed, np.repeat(cost, 2, axis=1)[:, ::2]):
        ranked = k_best_assignments(other, idle, 7)
        np.testing.assert_array_equal(ranked.columns, plain.columns)
        np.testing.assert_array_equal(ranked.costs, plain.costs)


def test_none_asked_for_is_none() -> None:
    for k in (0, -1):
        ranked = k_best_assignments(np.zeros((2, 3)), np.zeros(2), k)
        assert ranked.columns.shape == (0, 2) and len(ranked.costs) == 0


def test_shapes_that_do_not_fit_are_refused() -> None:
    for cost, idle in ((np.zeros((2, 3)), np.zeros(3)), (np.zeros(2), np.zeros(2))):
        with pytest.raises(ValueError, match="shape"):
            k_best_assignments(cost, idle, 1)


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
    assert ranked.columns.tolist() == [[NONE] * 3] and ranked.costs.tolist() == [7.0]


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
    idle = rng.normal(size=4)
    assert cluster_heads(sparse_problem(cost, idle), 5).tolist() == [0, 1, 0, 1]
    for k in (1, 3, 7, 100):
        check(cost, idle, k)


def test_clusters_against_the_same_problem_made_dense() -> None:
    # A cost that nobody pays instead of infinity: one cluster, the same best solutions.
    for seed in range(20):
        rng = np.random.default_rng(seed)
        cost, idle = rng.normal(size=(5, 6)), rng.normal(size=5)
        gate = rng.random(cost.shape) < 0.6
        sparse, dense = np.where(gate, np.inf, cost), np.where(gate, 1e6, cost)
        assert not cluster_heads(sparse_problem(dense, idle), 6).any()
        one, other = k_best_assignments(sparse, idle, 12), k_best_assignments(dense, idle, 12)
        np.testing.assert_allclose(one.costs, other.costs[: len(one.costs)], atol=1e-6)
        np.testing.assert_array_equal(one.columns, other.columns[: len(one.columns)])


def test_the_problem_is_left_as_it_was() -> None:
    cost, idle = np.arange(6.0).reshape(2, 3), np.ones(2)
    k_best_assignments(cost, idle, 5)
    np.testing.assert_array_equal(cost, np.arange(6.0).reshape(2, 3))
    np.testing.assert_array_equal(idle, np.ones(2))
