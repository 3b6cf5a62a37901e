"""The k best assignments of rows to columns: Murty's algorithm, cluster by cluster.

Murty's algorithm divides all assignments but the best one, A, into parts: part r holds those that
agree with A in the rows before r and differ from it at row r. The best of each part is found, and
whichever is the cheapest of all so far is the next best; its own part is then divided in the same
way. The dual variables of A still hold in each of its parts, so one shortest path solves a part:
from row r, which may not have its column any more, to that column. The best that row r may have
instead bounds the cost of the part from below, so that most parts need not be solved at all
(Miller, Stone and Cox 1997).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dopslam_ros.core.association.clusters import cluster_heads, cut_out
from dopslam_ros.core.association.shortest_path import (
    Search,
    Solution,
    Sparse,
    augment,
    best_offer,
    new_search,
    new_solution,
    set_row_duals,
    sparse,
)
from dopslam_ros.core.association.sorted_list import insert, smallest_sums
from dopslam_ros.core.linalg.arrays import FloatArray, IntArray
from dopslam_ros.core.linalg.jit import from_python, jit
from dopslam_ros.core.settings.layout import NONE


class Ranking(NamedTuple):
    """The K best assignments so far; those after the last one divided may still be displaced.

    Attributes:
        found: (1,) how many there are.
        cost: (K,) ascending.
        ticket: (K,) the row of the following arrays that a cost belongs to.
        pair: (K, N) of each row.
        v: (K, M) dual variables of the columns.
        parent: (K,) from whose parts it comes, or NONE.
        fixed: (K,) the row at which it differs from its parent; the rows before agree.
    """

    found: IntArray
    cost: FloatArray
    ticket: IntArray
    pair: IntArray
    v: FloatArray
    parent: IntArray
    fixed: IntArray


@jit
def new_ranking(size: int, rows: int, columns: int) -> Ranking:
    """Room for so many assignments."""
    return Ranking(
        np.zeros(1, np.int64),
        np.empty(size),
        np.empty(size, np.int64),
        np.empty((size, rows), np.int64),
        np.empty((size, columns)),
        np.full(size, NONE),
        np.zeros(size, np.int64),
    )


@jit
def wanted(ranking: Ranking, cost: float, limit: float) -> bool:
    """Whether an assignment of this cost would be among the best so far, and within the limit."""
    last = len(ranking.cost) - 1
    return cost <= limit and (ranking.found[0] <= last or cost < ranking.cost[last])


@jit
def store(ranking: Ranking, solution: Solution, cost: float) -> int:
    """Adds an assignment, in place of the last one where there is no room; returns its ticket."""
    size = len(ranking.cost)
    at = ranking.found[0] if ranking.found[0] < size else ranking.ticket[size - 1]
    for row in range(len(solution.pair)):
        ranking.pair[at, row] = solution.pair[row]
    for column in range(ranking.v.shape[1]):
        ranking.v[at, column] = solution.v[column]
    insert(ranking.cost, ranking.ticket, ranking.found, cost, at)
    return int(at)


@jit
def restore(problem: Sparse, ranking: Ranking, at: int, solution: Solution) -> None:
    """Makes ``solution`` the assignment with the ticket ``at``."""
    idle = ranking.v.shape[1]
    for column in range(idle):
        solution.row[column] = NONE
        solution.v[column] = ranking.v[at, column]
    for row in range(len(solution.pair)):
        pair = ranking.pair[at, row]
        solution.pair[row] = pair
        if problem.column[pair] != idle:
            solution.row[problem.column[pair]] = row
    set_row_duals(problem, solution)


@jit
def forbid(allowed: Sparse, ranking: Ranking, at: int, row: int) -> None:
    """Forbids a row its pair in an assignment, and in the ancestors it differs from at that row."""
    allowed.cost[ranking.pair[at, row]] = math.inf
    while ranking.parent[at] != NONE and ranking.fixed[at] == row:
        at = ranking.parent[at]
        allowed.cost[ranking.pair[at, row]] = math.inf


@jit
def divide(
    problem: Sparse,
    allowed: Sparse,
    solution: Solution,
    search: Search,
    ranking: Ranking,
    rank: int,
    limit: float,
) -> None:
    """Adds the best assignment of each part around one that was found, where it is wanted.

    Args:
        problem: all pairs.
        allowed: the same, of which pairs are forbidden during a search.
        solution: to work with.
        search: to work with.
        ranking: the assignments found.
        rank: of the one whose part is divided.
        limit: assignments that cost more are not wanted.
    """
    at = ranking.ticket[rank]
    cost = ranking.cost[rank]
    restore(problem, ranking, at, solution)
    for row in range(ranking.fixed[at], len(solution.pair)):
        forbid(allowed, ranking, at, row)
        offer = best_offer(allowed, solution, row, row)
        least = cost + max(0.0, offer - solution.u[row])
        if offer < math.inf and wanted(ranking, least, limit):
            target = problem.column[solution.pair[row]]
            solution.pair[row] = NONE
            solution.row[target] = NONE
            if augment(allowed, solution, search, row, target, row):
                # Never cheaper than the parent, whatever the rounding.
                found = max(cost, set_row_duals(problem, solution))
                if wanted(ranking, found, limit):
                    child = store(ranking, solution, found)
                    ranking.parent[child] = at
                    ranking.fixed[child] = row
            restore(problem, ranking, at, solution)
        for pair in range(problem.start[row], problem.start[row + 1]):
            allowed.cost[pair] = problem.cost[pair]


@jit
def k_best_of_cluster(
    problem: Sparse, columns: int, k: int, slack: float
) -> tuple[IntArray, FloatArray]:
    """The k cheapest assignments, as far as they cost at most ``slack`` more than the cheapest.

    Args:
        problem: N rows.
        columns: M, the idle column not among them.
        k: how many at most.
        slack: at least 0.

    Returns:
        (H, N) columns, and (H,) costs, ascending; none where there is no assignment.
    """
    rows = len(problem.start) - 1
    possible = 1.0
    for row in range(rows):
        possible = min(possible * (problem.start[row + 1] - problem.start[row]), float(k))
    size = int(possible)
    solution, search = new_solution(rows, columns), new_search(columns)
    ranking = new_ranking(size, rows, columns)
    cost = 0.0
    for row in range(rows):
        if size == 0 or not augment(problem, solution, search, row, columns, ranking.fixed[0]):
            return ranking.pair[:0], ranking.cost[:0]
        cost = set_row_duals(problem, solution)
    store(ranking, solution, cost)
    allowed = Sparse(problem.start, problem.row, problem.column, problem.cost.copy())
    for rank in range(size - 1):
        if rank < ranking.found[0]:
            divide(problem, allowed, solution, search, ranking, rank, ranking.cost[0] + slack)
    chosen = np.empty((ranking.found[0], rows), np.int64)
    for rank in range(ranking.found[0]):
        for row in range(rows):
            chosen[rank, row] = problem.column[ranking.pair[ranking.ticket[rank], row]]
    return chosen, ranking.cost[: ranking.found[0]]


@from_python
def k_best(cost: FloatArray, idle_cost: FloatArray, k: int) -> tuple[IntArray, FloatArray]:
    """The k cheapest assignments: those of each cluster by themselves, then the cheapest sums.

    Args:
        cost: (R, C), not finite where a pair is ruled out.
        idle_cost: (R,), not finite where a row must get a column.
        k: how many at most.

    Returns:
        (H, R) columns, NONE for none, and (H,) costs, ascending.
    """
    rows, columns = cost.shape
    problem = sparse(cost, idle_cost)
    head = cluster_heads(problem, columns)
    chosen = np.full((min(max(k, 0), 1), rows), NONE)
    costs = np.zeros(len(chosen))
    for first in range(rows):
        if head[first] != first or len(costs) == 0:
            continue
        part, members, names = cut_out(problem, columns, head, first)
        slack = costs[k - 1] - costs[0] if len(costs) == k else math.inf
        found, more = k_best_of_cluster(part, len(names) - 1, k, slack)
        costs, tickets = smallest_sums(costs, more, k)
        table = np.empty((len(costs), rows), np.int64)
        for h in range(len(costs)):
            before, now = tickets[h] // len(more), tickets[h] % len(more)
            for row in range(rows):
                table[h, row] = chosen[before, row]
            for i in range(len(members)):
                table[h, members[i]] = names[found[now, i]]
        chosen = table
    return chosen, costs
