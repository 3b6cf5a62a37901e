"""The k best assignments of rows to columns: Murty's ranking, cluster by cluster.

Murty's method splits the solutions around one that was found by its rows: those that agree with it
before row r and differ at r. The prices of the parent still hold in such a part, so one shortest
path, from r to what r had, solves it; and the cheapest other option of r bounds its cost from
below, so that most parts need not be solved at all (Miller, Stone and Cox 1997).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dopslam_ros.core.association.shortest_path import (
    Search,
    Solution,
    Sparse,
    augment,
    cheapest,
    price_rows,
    sparse,
)
from dopslam_ros.core.linalg.arrays import FloatArray, IntArray
from dopslam_ros.core.linalg.jit import from_python, jit
from dopslam_ros.core.settings.layout import NONE


class Ranking(NamedTuple):
    """The K best solutions so far; those after the last one split may still be displaced.

    Attributes:
        found: (1,) how many there are.
        cost: (K,) ascending.
        ticket: (K,) which of the following a cost belongs to.
        pair: (K, N) of each row.
        price: (K, M) of the columns.
        parent: (K,) from which it was split, or NONE.
        fixed: (K,) the row at which it differs from its parent; the rows before agree.
    """

    found: IntArray
    cost: FloatArray
    ticket: IntArray
    pair: IntArray
    price: FloatArray
    parent: IntArray
    fixed: IntArray


@jit
def insert(keys: FloatArray, tickets: IntArray, count: IntArray, key: float, ticket: int) -> None:
    """Puts a ticket behind those whose keys are not larger; from a full list the last falls off.

    Args:
        keys: (n,) ascending, as far as they are filled.
        tickets: (n,) of the keys.
        count: (1,) how many are filled.
        key: of the ticket.
        ticket: to be put in.
    """
    size = len(keys)
    at = min(count[0], size - 1)
    if count[0] == size and key >= keys[at]:
        return
    while at > 0 and keys[at - 1] > key:
        keys[at] = keys[at - 1]
        tickets[at] = tickets[at - 1]
        at -= 1
    keys[at] = key
    tickets[at] = ticket
    count[0] = min(count[0] + 1, size)


@from_python
def cluster_heads(problem: Sparse, columns: int) -> IntArray:
    """(N,) the first row of the cluster each row is in; clusters share no column."""
    head = np.arange(len(problem.start) - 1)
    first = np.full(columns, NONE)
    for pair in range(len(problem.row)):
        row, column = problem.row[pair], problem.column[pair]
        if column == columns:  # everybody's ground
            continue
        if first[column] == NONE:
            first[column] = row
        a, b = row, first[column]
        while head[a] != a:
            head[a] = head[head[a]]
            a = head[a]
        while head[b] != b:
            head[b] = head[head[b]]
            b = head[b]
        head[max(a, b)] = min(a, b)
    for row in range(len(head)):  # heads come before their members
        head[row] = head[head[row]]
    return head


@jit
def cut_out(
    problem: Sparse, columns: int, head: IntArray, first: int
) -> tuple[Sparse, IntArray, IntArray]:
    """The cluster whose first row is ``first`` as a problem of its own.

    Returns:
        The problem, its (N,) rows and (M + 1,) columns; the ground is called NONE.
    """
    size, pairs = 0, 0
    for row in range(first, len(head)):
        if head[row] == first:
            size += 1
            pairs += problem.start[row + 1] - problem.start[row]
    members, start = np.empty(size, np.int64), np.zeros(size + 1, np.int64)
    owner, column, cost = np.empty(pairs, np.int64), np.empty(pairs, np.int64), np.empty(pairs)
    number, names = np.full(columns + 1, NONE), np.empty(pairs + 1, np.int64)
    used, n, filled = 0, 0, 0
    for row in range(first, len(head)):
        if head[row] != first:
            continue
        for pair in range(problem.start[row], problem.start[row + 1]):
            name = problem.column[pair]
            if number[name] == NONE and name != columns:
                number[name] = used
                names[used] = name
                used += 1
            owner[filled] = n
            column[filled] = number[name]
            cost[filled] = problem.cost[pair]
            filled += 1
        members[n] = row
        n += 1
        start[n] = filled
    for pair in range(pairs):
        if column[pair] == NONE:
            column[pair] = used
    names[used] = NONE
    return Sparse(start, owner, column, cost), members, names[: used + 1]


@jit
def wanted(costs: FloatArray, found: IntArray, cost: float, limit: float) -> bool:
    """Whether a solution of this cost would be among the best so far, (K,) ``found`` (1,)."""
    last = len(costs) - 1
    return cost <= limit and (found[0] <= last or cost < costs[last])


@jit
def keep(ranking: Ranking, solution: Solution, cost: float) -> int:
    """Adds a solution, in place of the last one where there is no room; tells its ticket."""
    size = len(ranking.cost)
    at = ranking.found[0] if ranking.found[0] < size else ranking.ticket[size - 1]
    for row in range(len(solution.pair)):
        ranking.pair[at, row] = solution.pair[row]
    for column in range(ranking.price.shape[1]):
        ranking.price[at, column] = solution.v[column]
    insert(ranking.cost, ranking.ticket, ranking.found, cost, at)
    return int(at)


@jit
def load(problem: Sparse, ranking: Ranking, at: int, solution: Solution) -> None:
    """Makes ``solution`` the one that was kept."""
    ground = ranking.price.shape[1]
    for column in range(ground):
        solution.row[column] = NONE
        solution.v[column] = ranking.price[at, column]
    for row in range(len(solution.pair)):
        pair = ranking.pair[at, row]
        solution.pair[row] = pair
        if problem.column[pair] != ground:
            solution.row[problem.column[pair]] = row
    price_rows(problem, solution)


@jit
def forbid(allowed: Sparse, ranking: Ranking, at: int, row: int) -> None:
    """Takes from a row what it has in a solution and in those that this was split from there."""
    allowed.cost[ranking.pair[at, row]] = math.inf
    while ranking.parent[at] != NONE and ranking.fixed[at] == row:
        at = ranking.parent[at]
        allowed.cost[ranking.pair[at, row]] = math.inf


@jit
def split(
    problem: Sparse,
    allowed: Sparse,
    solution: Solution,
    search: Search,
    ranking: Ranking,
    rank: int,
    limit: float,
) -> None:
    """Adds the best solution of each part around the solution of a rank, where it is wanted.

    Args:
        problem: all pairs.
        allowed: the same, from which pairs are taken for the time of a search.
        solution: to work with.
        search: to work with.
        ranking: of the solutions found.
        rank: which to split.
        limit: solutions that cost more are not wanted.
    """
    at = ranking.ticket[rank]
    cost = ranking.cost[rank]
    load(problem, ranking, at, solution)
    for row in range(ranking.fixed[at], len(solution.pair)):
        forbid(allowed, ranking, at, row)
        other = cheapest(allowed, solution, row, row)
        least = cost + max(0.0, other - solution.u[row])
        if other < math.inf and wanted(ranking.cost, ranking.found, least, limit):
            target = problem.column[solution.pair[row]]
            solution.pair[row] = NONE
            solution.row[target] = NONE
            if augment(allowed, solution, search, row, target, row):
                # Never cheaper than the parent, whatever the rounding.
                found = max(cost, price_rows(problem, solution))
                if wanted(ranking.cost, ranking.found, found, limit):
                    child = keep(ranking, solution, found)
                    ranking.parent[child] = at
                    ranking.fixed[child] = row
            load(problem, ranking, at, solution)
        for pair in range(problem.start[row], problem.start[row + 1]):
            allowed.cost[pair] = problem.cost[pair]


@jit
def rank_cluster(
    problem: Sparse, columns: int, k: int, slack: float
) -> tuple[IntArray, FloatArray]:
    """The k cheapest solutions, as far as they cost at most ``slack`` more than the cheapest.

    Args:
        problem: N rows.
        columns: M, the ground not among them.
        k: how many at most.
        slack: at least 0.

    Returns:
        (H, N) columns, and (H,) costs, ascending; none where there is no solution.
    """
    rows = len(problem.start) - 1
    possible = 1.0
    for row in range(rows):
        possible = min(possible * (problem.start[row + 1] - problem.start[row]), float(k))
    size = int(possible)
    ints = np.empty((3, columns + 1), np.int64)
    solution = Solution(
        np.full(rows, NONE), np.full(columns + 1, NONE), np.empty(rows), np.zeros(columns + 1)
    )
    search = Search(np.empty(columns + 1), ints[0], ints[1], ints[2], np.zeros(1, np.int64))
    ranking = Ranking(
        np.zeros(1, np.int64),
        np.empty(size),
        np.empty(size, np.int64),
        np.empty((size, rows), np.int64),
        np.empty((size, columns)),
        np.full(size, NONE),
        np.zeros(size, np.int64),
    )
    cost = 0.0
    for row in range(rows):
        if size == 0 or not augment(problem, solution, search, row, columns, ranking.fixed[0]):
            return ranking.pair[:0], ranking.cost[:0]
        cost = price_rows(problem, solution)
    keep(ranking, solution, cost)
    allowed = Sparse(problem.start, problem.row, problem.column, problem.cost.copy())
    for rank in range(size - 1):
        if rank < ranking.found[0]:
            split(problem, allowed, solution, search, ranking, rank, ranking.cost[0] + slack)
    chosen = np.empty((ranking.found[0], rows), np.int64)
    for rank in range(ranking.found[0]):
        for row in range(rows):
            chosen[rank, row] = problem.column[ranking.pair[ranking.ticket[rank], row]]
    return chosen, ranking.cost[: ranking.found[0]]


@jit
def combine(costs: FloatArray, more: FloatArray, k: int) -> tuple[FloatArray, IntArray]:
    """The k smallest sums of one of ``costs`` (A,) and one of ``more`` (B,), both ascending.

    Returns:
        (H,) sums, ascending, and (H,) tickets a B + b.
    """
    size = min(k, len(costs) * len(more))
    sums = np.empty(size)
    tickets = np.empty(size, np.int64)
    count = np.zeros(1, np.int64)
    for a in range(len(costs)):
        # (a + 1) (b + 1) - 1 sums are no larger than that of a and b.
        for b in range(min(len(more), k // (a + 1))):
            value = costs[a] + more[b]
            if count[0] == size and value >= sums[size - 1]:
                break
            insert(sums, tickets, count, value, a * len(more) + b)
    return sums, tickets


@from_python
def k_best(cost: FloatArray, idle_cost: FloatArray, k: int) -> tuple[IntArray, FloatArray]:
    """The k cheapest assignments; those of the clusters are ranked apart and combined.

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
        found, more = rank_cluster(part, len(names) - 1, k, slack)
        costs, tickets = combine(costs, more, k)
        table = np.empty((len(costs), rows), np.int64)
        for h in range(len(costs)):
            before, now = tickets[h] // len(more), tickets[h] % len(more)
            for row in range(rows):
                table[h, row] = chosen[before, row]
            for i in range(len(members)):
                table[h, members[i]] = names[found[now, i]]
        chosen = table
    return chosen, costs
