"""The cheapest assignment of rows to columns, grown and changed by shortest augmenting paths.

A row takes a column or stays idle, a column is taken or left free. To have nothing is to have the
ground, a last column that any number may share. A solution is held together with prices v <= 0 of
the columns that prove it the cheapest: u_r + v_c <= cost_rc, with equality for what row r has, and
v_c = 0 where column c is free (Jonker and Volgenant 1987; the prices u of the rows follow).

Counts are kept in arrays and "nobody" is never an argument: the compiler would make a function
anew for every literal number it is called with.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dopslam_ros.core.linalg.arrays import FloatArray, IntArray
from dopslam_ros.core.linalg.jit import from_python, jit
from dopslam_ros.core.settings.layout import NONE


class Sparse(NamedTuple):
    """N rows, M columns beside the ground, which is column M, and the E pairs that are possible.

    Attributes:
        start: (N + 1,) the pairs of row r are start[r] ... start[r + 1] - 1.
        row: (E,) of each pair, ascending.
        column: (E,) of each pair.
        cost: (E,) of each pair; inf where it is forbidden for now.
    """

    start: IntArray
    row: IntArray
    column: IntArray
    cost: FloatArray


class Solution(NamedTuple):
    """Who has what, and the prices.

    Attributes:
        pair: (N,) of each row, or NONE.
        row: (M + 1,) of each column, or NONE as the ground always is.
        u: (N,) price of each row.
        v: (M + 1,) price of each column; that of the ground is 0.
    """

    pair: IntArray
    row: IntArray
    u: FloatArray
    v: FloatArray


class Search(NamedTuple):
    """Shortest paths to the columns.

    Attributes:
        distance: (M + 1,) inf where not reached.
        settled: (M + 1,) 1 where the distance is final.
        pair: (M + 1,) by which a column was reached, or E: from the ground, by leaving it free.
        waiting: (M + 1,) columns that are reached but not settled; the first so many.
        length: (1,) how many are waiting.
    """

    distance: FloatArray
    settled: IntArray
    pair: IntArray
    waiting: IntArray
    length: IntArray


@from_python
def sparse(cost: FloatArray, idle: FloatArray) -> Sparse:
    """The finite entries of cost (N, M) and idle (N,), by rows."""
    rows, columns = cost.shape
    most = rows * (columns + 1)
    start = np.zeros(rows + 1, np.int64)
    row, column, finite = np.empty(most, np.int64), np.empty(most, np.int64), np.empty(most)
    pair = 0
    for r in range(rows):
        for c in range(columns + 1):
            value = cost[r, c] if c < columns else idle[r]
            if abs(value) < math.inf:
                row[pair] = r
                column[pair] = c
                finite[pair] = value
                pair += 1
        start[r + 1] = pair
    return Sparse(start, row[:pair], column[:pair], finite[:pair])


@jit
def reach(
    search: Search, solution: Solution, column: int, pair: int, distance: float, target: int
) -> None:
    """Notes a path to a column, unless a shorter one is known, to it or to the target.

    What is free leads to the ground, and nowhere else.
    """
    ground = len(search.distance) - 1
    node = ground if solution.row[column] == NONE and column != target else column
    known = search.distance[node]
    if search.settled[node] or not distance < min(known, search.distance[target]):
        return
    search.distance[node] = distance
    search.pair[node] = pair
    if known == math.inf:
        search.waiting[search.length[0]] = node
        search.length[0] += 1


@jit
def leave_row(
    problem: Sparse,
    solution: Solution,
    search: Search,
    row: int,
    at: float,
    target: int,
    fixed: int,
) -> None:
    """Goes on from a row at distance ``at`` to all that it may have instead."""
    base = at - solution.u[row]
    for pair in range(problem.start[row], problem.start[row + 1]):
        column = problem.column[pair]
        if not 0 <= solution.row[column] < fixed:
            distance = max(at, base + problem.cost[pair] - solution.v[column])
            reach(search, solution, column, pair, distance, target)


@jit
def leave_ground(
    problem: Sparse, solution: Solution, search: Search, at: float, target: int, fixed: int
) -> None:
    """Goes on from the ground: a column is left free, an idle row takes something."""
    ground = len(search.distance) - 1
    nobody = len(problem.row)
    for column in range(ground):
        if solution.row[column] >= fixed or column == target:
            reach(search, solution, column, nobody, max(at, at - solution.v[column]), target)
    for row in range(fixed, len(solution.pair)):
        pair = solution.pair[row]
        if pair != NONE and problem.column[pair] == ground:
            leave_row(problem, solution, search, row, at, target, fixed)


@jit
def cheapest(problem: Sparse, solution: Solution, row: int, fixed: int) -> float:
    """The cheapest that a row may have at these prices; inf where there is nothing."""
    best = math.inf
    for pair in range(problem.start[row], problem.start[row + 1]):
        column = problem.column[pair]
        if not 0 <= solution.row[column] < fixed:
            best = min(best, problem.cost[pair] - solution.v[column])
    return best


@jit
def shortest_path(
    problem: Sparse, solution: Solution, search: Search, row: int, target: int, fixed: int
) -> float:
    """Dijkstra's search over reduced costs from a row that is open to a target that is free.

    Args:
        problem: what may be had.
        solution: of all rows but this one, whose u is set.
        search: filled in.
        row: where to start.
        target: the column that is to be filled, or the ground.
        fixed: rows before this one keep what they have.

    Returns:
        The distance; inf where there is no path.
    """
    ground = len(search.distance) - 1
    for column in range(ground + 1):
        search.distance[column] = math.inf
        search.settled[column] = 0
    search.length[0] = 0
    solution.u[row] = cheapest(problem, solution, row, fixed)
    if solution.u[row] < math.inf:
        leave_row(problem, solution, search, row, 0.0, target, fixed)
    while search.length[0] > 0:
        best = 0
        for i in range(1, search.length[0]):
            if search.distance[search.waiting[i]] < search.distance[search.waiting[best]]:
                best = i
        node = search.waiting[best]
        at = search.distance[node]
        if node == target:
            return float(at)
        search.length[0] -= 1
        search.waiting[best] = search.waiting[search.length[0]]
        search.settled[node] = 1
        if node == ground:
            leave_ground(problem, solution, search, at, target, fixed)
        else:
            leave_row(problem, solution, search, solution.row[node], at, target, fixed)
    return math.inf


@jit
def augment(
    problem: Sparse, solution: Solution, search: Search, row: int, target: int, fixed: int
) -> bool:
    """Gives an open row something and fills the target, at least cost; u does not follow.

    Arguments as in ``shortest_path``.

    Returns:
        Whether that is possible; if not, who has what is as it was.
    """
    length = shortest_path(problem, solution, search, row, target, fixed)
    if length == math.inf:
        return False
    ground = len(search.distance) - 1
    lift = max(0.0, length - search.distance[ground])
    for column in range(ground):
        if solution.row[column] != NONE or column == target:
            solution.v[column] += lift - max(0.0, length - search.distance[column])
    node = target
    while True:
        pair = search.pair[node]
        if pair == len(problem.row):
            solution.row[node] = NONE
            solution.v[node] = 0.0
            pair = search.pair[ground]
        holder = problem.row[pair]
        left = solution.pair[holder]
        solution.pair[holder] = pair
        if problem.column[pair] != ground:
            solution.row[problem.column[pair]] = holder
        if holder == row:
            return True
        node = problem.column[left]


@jit
def price_rows(problem: Sparse, solution: Solution) -> float:
    """Sets u to what each row pays at the prices of the columns.

    Returns:
        The cost of the solution.
    """
    cost = 0.0
    for row in range(len(solution.pair)):
        pair = solution.pair[row]
        if pair != NONE:
            solution.u[row] = problem.cost[pair] - solution.v[problem.column[pair]]
            cost += problem.cost[pair]
    return cost
