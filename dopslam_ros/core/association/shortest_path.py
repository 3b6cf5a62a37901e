"""The cheapest assignment of rows to columns, built up and changed by shortest augmenting paths.

A row gets a column of its own or stays unassigned; a column may stay unassigned as well. For a row
to stay unassigned is to get the *idle* column, the last one, which any number of rows may share.

An assignment is known to be the cheapest by its dual variables, u of the rows and v <= 0 of the
columns: u_r + v_c <= cost_rc for every pair, with equality for the pairs assigned, and v_c = 0 for
every column c that no row has (Jonker and Volgenant 1987). The reduced costs cost_rc - u_r - v_c
are therefore not negative, so that Dijkstra's search finds the cheapest chain of changes by which
one more row is assigned.

Counts are kept in arrays and NONE is never an argument: the compiler would make a function anew
for every literal number it is called with.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dopslam_ros.core.linalg.arrays import FloatArray, IntArray
from dopslam_ros.core.linalg.jit import from_python, jit
from dopslam_ros.core.settings.layout import NONE


class Sparse(NamedTuple):
    """N rows, M columns and the idle column, number M, and the E pairs that are possible.

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
    """An assignment and its dual variables.

    Attributes:
        pair: (N,) the pair by which each row has its column, or NONE where it is still open.
        row: (M + 1,) the row that has each column, or NONE, as always for the idle column.
        u: (N,) dual variables of the rows.
        v: (M + 1,) dual variables of the columns; 0 for the idle column.
    """

    pair: IntArray
    row: IntArray
    u: FloatArray
    v: FloatArray


class Search(NamedTuple):
    """Shortest paths to the columns, by Dijkstra's search.

    Attributes:
        distance: (M + 1,) inf where not reached.
        settled: (M + 1,) 1 where the distance is final.
        pair: (M + 1,) by which a column was reached; E where it was reached from the idle column,
            which means that its row gives it up and no other takes it.
        queue: (M + 1,) columns that are reached but not settled; the first so many.
        length: (1,) of the queue.
    """

    distance: FloatArray
    settled: IntArray
    pair: IntArray
    queue: IntArray
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
def new_solution(rows: int, columns: int) -> Solution:
    """All rows open; the idle column is not counted."""
    return Solution(
        np.full(rows, NONE), np.full(columns + 1, NONE), np.empty(rows), np.zeros(columns + 1)
    )


@jit
def new_search(columns: int) -> Search:
    """Room for a search through so many columns, the idle one not counted."""
    numbers = np.empty((3, columns + 1), np.int64)
    return Search(np.empty(columns + 1), numbers[0], numbers[1], numbers[2], np.zeros(1, np.int64))


@jit
def is_fixed(solution: Solution, column: int, fixed: int) -> bool:
    """Whether a column belongs to one of the first ``fixed`` rows, which keep what they have."""
    row: int = solution.row[column]
    return row != NONE and row < fixed


@jit
def relax(
    search: Search, solution: Solution, column: int, pair: int, distance: float, target: int
) -> None:
    """Notes a path to a column, unless one as short is known, to it or to the target.

    A column that no row has ends a chain of changes as the idle column does, so that all of these
    are one node of the search.
    """
    idle = len(search.distance) - 1
    node = idle if solution.row[column] == NONE and column != target else column
    known = search.distance[node]
    if search.settled[node] or not distance < min(known, search.distance[target]):
        return
    search.distance[node] = distance
    search.pair[node] = pair
    if known == math.inf:
        search.queue[search.length[0]] = node
        search.length[0] += 1


@jit
def relax_row(
    problem: Sparse,
    solution: Solution,
    search: Search,
    row: int,
    at: float,
    target: int,
    fixed: int,
) -> None:
    """Goes on from a row at distance ``at`` to every column that it may have instead."""
    base = at - solution.u[row]
    for pair in range(problem.start[row], problem.start[row + 1]):
        column = problem.column[pair]
        if not is_fixed(solution, column, fixed):
            distance = max(at, base + problem.cost[pair] - solution.v[column])
            relax(search, solution, column, pair, distance, target)


@jit
def relax_idle(
    problem: Sparse, solution: Solution, search: Search, at: float, target: int, fixed: int
) -> None:
    """Goes on from the idle column: a column loses its row, or an unassigned row gets a column."""
    idle = len(search.distance) - 1
    given_up = len(problem.row)
    for column in range(idle):
        loses = solution.row[column] != NONE and not is_fixed(solution, column, fixed)
        if loses or column == target:
            relax(search, solution, column, given_up, max(at, at - solution.v[column]), target)
    for row in range(fixed, len(solution.pair)):
        pair = solution.pair[row]
        if pair != NONE and problem.column[pair] == idle:
            relax_row(problem, solution, search, row, at, target, fixed)


@jit
def best_offer(problem: Sparse, solution: Solution, row: int, fixed: int) -> float:
    """The least cost_rc - v_c among the columns that a row may have; inf where there is none."""
    best = math.inf
    for pair in range(problem.start[row], problem.start[row + 1]):
        column = problem.column[pair]
        if not is_fixed(solution, column, fixed):
            best = min(best, problem.cost[pair] - solution.v[column])
    return best


@jit
def shortest_path(
    problem: Sparse, solution: Solution, search: Search, row: int, target: int, fixed: int
) -> float:
    """Dijkstra's search over reduced costs from an open row to a target column without a row.

    Args:
        problem: the pairs that are possible.
        solution: of all rows but this one, whose u is set.
        search: filled in.
        row: where to start.
        target: the column that is to get a row, or the idle column.
        fixed: the rows before this one keep what they have.

    Returns:
        The distance; inf where there is no path.
    """
    idle = len(search.distance) - 1
    for column in range(idle + 1):
        search.distance[column] = math.inf
        search.settled[column] = 0
    search.length[0] = 0
    solution.u[row] = best_offer(problem, solution, row, fixed)
    if solution.u[row] < math.inf:
        relax_row(problem, solution, search, row, 0.0, target, fixed)
    while search.length[0] > 0:
        node = take_nearest(search)
        at = search.distance[node]
        if node == target:
            return float(at)
        if node == idle:
            relax_idle(problem, solution, search, at, target, fixed)
        else:
            relax_row(problem, solution, search, solution.row[node], at, target, fixed)
    return math.inf


@jit
def take_nearest(search: Search) -> int:
    """Takes the nearest column from the queue, which settles it; of equal ones the first."""
    best = 0
    for i in range(1, search.length[0]):
        if search.distance[search.queue[i]] < search.distance[search.queue[best]]:
            best = i
    node = search.queue[best]
    search.length[0] -= 1
    search.queue[best] = search.queue[search.length[0]]
    search.settled[node] = 1
    return int(node)


@jit
def augment(
    problem: Sparse, solution: Solution, search: Search, row: int, target: int, fixed: int
) -> bool:
    """Assigns an open row, and the target to some row, at least cost; u does not follow.

    Arguments as in ``shortest_path``.

    Returns:
        Whether that is possible; if not, the assignment is as it was.
    """
    length = shortest_path(problem, solution, search, row, target, fixed)
    if length == math.inf:
        return False
    idle = len(search.distance) - 1
    lift = max(0.0, length - search.distance[idle])
    for column in range(idle):
        if solution.row[column] != NONE or column == target:
            solution.v[column] += lift - max(0.0, length - search.distance[column])
    # Back along the path: each column goes to the row by which it was reached.
    node = target
    while True:
        pair = search.pair[node]
        if pair == len(problem.row):  # given up by its row, which stays unassigned
            solution.row[node] = NONE
            solution.v[node] = 0.0
            pair = search.pair[idle]
        taker = problem.row[pair]
        left = solution.pair[taker]
        solution.pair[taker] = pair
        if problem.column[pair] != idle:
            solution.row[problem.column[pair]] = taker
        if taker == row:
            return True
        node = problem.column[left]


@jit
def set_row_duals(problem: Sparse, solution: Solution) -> float:
    """Sets u_r = cost_rc - v_c, c the column of row r.

    Returns:
        The cost of the assignment.
    """
    cost = 0.0
    for row in range(len(solution.pair)):
        pair = solution.pair[row]
        if pair != NONE:
            solution.u[row] = problem.cost[pair] - solution.v[problem.column[pair]]
            cost += problem.cost[pair]
    return cost
