"""Augmenting paths: the dual variables as the witness that an assignment is the cheapest."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from dopslam_ros.core.association import shortest_path as kernels
from dopslam_ros.core.association.shortest_path import Search, Solution, Sparse, sparse
from dopslam_ros.core.linalg.arrays import FloatArray
from dopslam_ros.core.linalg.jit import from_python
from dopslam_ros.core.settings.layout import NONE

new_solution = from_python(kernels.new_solution)
new_search = from_python(kernels.new_search)
augment = from_python(kernels.augment)
set_row_duals = from_python(kernels.set_row_duals)


def nothing_given(rows: int, columns: int) -> tuple[Solution, Search]:
    return new_solution(rows, columns), new_search(columns)


def assert_proven(problem: Sparse, solution: Solution, columns: int) -> None:
    """Each row has a column of its own or the idle one, and the duals prove it the cheapest."""
    has = problem.column[solution.pair]
    np.testing.assert_array_equal(problem.row[solution.pair], np.arange(len(has)))
    for column in range(columns):
        holders = np.flatnonzero(has == column)
        assert len(holders) <= 1
        assert solution.row[column] == (holders[0] if len(holders) else NONE)
    reduced = problem.cost - solution.u[problem.row] - solution.v[problem.column]
    assert np.all(reduced > -1e-9) and np.all(solution.v <= 1e-9)
    np.testing.assert_allclose(reduced[solution.pair], 0.0, atol=1e-9)
    np.testing.assert_array_equal(solution.v[solution.row == NONE], 0.0)


def cheapest(problem: Sparse, rows: int, columns: int) -> float:
    """What SciPy pays, every row having an idle column of its own; inf where it finds nothing."""
    square = np.full((rows, columns + rows), np.inf)
    column = np.where(problem.column < columns, problem.column, columns + problem.row)
    square[problem.row, column] = problem.cost
    try:
        return float(square[linear_sum_assignment(square)].sum())
    except ValueError:
        return np.inf


def random_costs(seed: int) -> tuple[FloatArray, FloatArray]:
    rng = np.random.default_rng(seed)
    rows, columns = (int(n) for n in rng.integers([1, 1], [13, 13]))
    cost, idle = rng.normal(-1.0, 2.0, (rows, columns)), rng.normal(size=rows)
    cost[rng.random(cost.shape) < 0.4] = np.inf
    return (np.round(cost), np.round(idle)) if seed % 2 else (cost, idle)


@pytest.mark.parametrize("seed", range(30))
def test_dual_variables_prove_each_solution_and_what_comes_of_it_when_a_pair_is_forbidden(
    seed: int,
) -> None:
    cost, idle = random_costs(seed)
    rows, columns = cost.shape
    problem = sparse(cost, idle)
    solution, search = nothing_given(rows, columns)
    for row in range(rows):
        assert augment(problem, solution, search, row, columns, 0)
        set_row_duals(problem, solution)
    assert_proven(problem, solution, columns)
    for row in range(rows):
        pair = solution.pair[row]
        problem.cost[pair] = np.inf
        target = problem.column[pair]
        solution.pair[row], solution.row[target] = NONE, NONE
        possible = augment(problem, solution, search, row, target, 0)
        assert possible == np.isfinite(cheapest(problem, rows, columns))
        if not possible:
            break
        assert set_row_duals(problem, solution) == pytest.approx(cheapest(problem, rows, columns))
        assert_proven(problem, solution, columns)


def test_what_is_not_finite_is_no_pair() -> None:
    problem = sparse(
        np.array([[1.0, np.nan, 2.0], [np.inf, -np.inf, np.nan]]), np.array([np.inf, 3.0])
    )
    assert problem.start.tolist() == [0, 2, 3]
    assert problem.row.tolist() == [0, 0, 1]
    assert problem.column.tolist() == [0, 2, 3]  # the last one is the idle column
    assert problem.cost.tolist() == [1.0, 2.0, 3.0]


@pytest.mark.parametrize("fixed, columns, total", [(0, [1, 0], 1.0), (1, [0, 2], 8.0)])
def test_rows_before_the_fixed_one_keep_what_they_have(
    fixed: int, columns: list[int], total: float
) -> None:
    # Both want column 0; the first row could do with column 1 as well.
    problem = sparse(np.array([[0.0, 1.0], [0.0, 9.0]]), np.array([9.0, 8.0]))
    solution, search = nothing_given(2, 2)
    for row, kept in ((0, 0), (1, fixed)):
        assert augment(problem, solution, search, row, 2, kept)
        cost = set_row_duals(problem, solution)
    assert problem.column[solution.pair].tolist() == columns and cost == total
