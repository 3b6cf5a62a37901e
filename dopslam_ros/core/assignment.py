"""The k best associations: Murty's method per independent cluster, clusters then combined."""

from __future__ import annotations

import heapq
from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from dopslam_ros.core.arrays import BoolArray, FloatArray, IntArray

# A row that is given to no column of its own choice.
UNASSIGNED = -1


class Ranked(NamedTuple):
    """Assignments in the order of their cost.

    Attributes:
        columns: (k, R) the column of each row, or UNASSIGNED.
        costs: (k,) ascending.
    """

    columns: IntArray
    costs: FloatArray


def k_best_assignments(cost: FloatArray, idle_cost: FloatArray, k: int) -> Ranked:
    """The k cheapest ways to give rows to columns, no column twice, any row may stay idle.

    Args:
        cost: (R, C) of giving a row to a column; inf where that is ruled out (gated).
        idle_cost: (R,) of a row that gets no column; inf where it must get one.
        k: how many at most.

    Returns:
        Up to k assignments; none when no assignment is possible.
    """
    ranked = Ranked(np.full((1, len(cost)), UNASSIGNED, dtype=np.int64), np.zeros(1))
    for rows, columns in clusters(np.isfinite(cost)):
        part = _murty(cost[np.ix_(rows, columns)], idle_cost[rows], k)
        if not len(part.costs):
            return Ranked(np.zeros((0, len(cost)), dtype=np.int64), np.zeros(0))
        chosen = np.where(
            part.columns == UNASSIGNED, UNASSIGNED, np.append(columns, 0)[part.columns]
        )
        ranked = _combine(ranked, rows, chosen, part.costs, k)
    return ranked


def clusters(possible: BoolArray) -> list[tuple[IntArray, IntArray]]:
    """Splits a problem into parts that share no column: connected components.

    Args:
        possible: (R, C) which row may get which column.

    Returns:
        (rows, columns) of each part that has a row, ordered by first row.
    """
    rows, columns = possible.shape
    edges = np.nonzero(possible)
    graph = coo_array(
        (np.ones(len(edges[0])), (edges[0], edges[1] + rows)), shape=(rows + columns,) * 2
    )
    _, label = connected_components(graph, directed=False)
    parts = []
    for part in dict.fromkeys(label[:rows].tolist()):
        members = np.flatnonzero(label == part)
        parts.append((members[members < rows], members[members >= rows] - rows))
    return parts


def _murty(cost: FloatArray, idle_cost: FloatArray, k: int) -> Ranked:
    """Murty's ranking of one cluster: split the solution space around each solution found."""
    rows, columns = cost.shape
    # Column C + r is row r's own way of staying idle.
    idle = np.full((rows, rows), np.inf)
    np.fill_diagonal(idle, idle_cost)
    first = np.hstack([cost, idle])
    queue: list[tuple[float, int, IntArray, FloatArray, int]] = []
    pushed = 0

    def push(problem: FloatArray, fixed: int) -> None:
        nonlocal pushed
        solution = _solve(problem)
        if solution is not None:
            total = float(first[np.arange(rows), solution].sum())
            heapq.heappush(queue, (total, pushed, solution, problem, fixed))
            pushed += 1

    push(first, 0)
    found: list[IntArray] = []
    costs: list[float] = []
    while queue and len(found) < k:
        total, _, solution, problem, fixed = heapq.heappop(queue)
        found.append(solution)
        costs.append(total)
        problem = problem.copy()
        for row in range(fixed, rows):
            # All solutions that agree with this one before ``row`` and differ at ``row``.
            child = problem.copy()
            child[row, solution[row]] = np.inf
            push(child, row)
            kept = problem[row, solution[row]]
            problem[row] = np.inf
            problem[:, solution[row]] = np.inf
            problem[row, solution[row]] = kept
    table = np.array(found, dtype=np.int64).reshape(-1, rows)
    return Ranked(np.where(table < columns, table, UNASSIGNED), np.array(costs))


def _solve(problem: FloatArray) -> IntArray | None:
    """The cheapest assignment, or None when there is none."""
    if not np.isfinite(problem).any(axis=1).all():
        return None
    try:
        _, columns = linear_sum_assignment(problem)
    except ValueError:  # SciPy's word for "infeasible"
        return None
    return np.asarray(columns, dtype=np.int64)


def _combine(ranked: Ranked, rows: IntArray, chosen: IntArray, costs: FloatArray, k: int) -> Ranked:
    """The k cheapest pairs of a solution so far and a solution of one more cluster."""
    total = ranked.costs[:, None] + costs[None, :]
    order = np.argsort(total, axis=None, kind="stable")[:k]
    old, new = np.unravel_index(order, total.shape)
    columns = ranked.columns[old].copy()
    columns[:, rows] = chosen[new]
    return Ranked(columns, total[old, new])
