"""An assignment problem falls into clusters of rows that share no column: solved one by one."""

from __future__ import annotations

import numpy as np

from dopslam_ros.core.association.shortest_path import Sparse
from dopslam_ros.core.linalg.arrays import IntArray
from dopslam_ros.core.linalg.jit import from_python, jit
from dopslam_ros.core.settings.layout import NONE


@from_python
def cluster_heads(problem: Sparse, columns: int) -> IntArray:
    """(N,) the first row of the cluster that each row belongs to: connected components.

    Args:
        problem: N rows.
        columns: M, the idle column, which connects no rows, not among them.
    """
    head = np.arange(len(problem.start) - 1)
    first = np.full(columns, NONE)
    for pair in range(len(problem.row)):
        row, column = problem.row[pair], problem.column[pair]
        if column == columns:
            continue
        if first[column] == NONE:
            first[column] = row
        join(head, row, first[column])
    for row in range(len(head)):  # heads come before their members
        head[row] = head[head[row]]
    return head


@jit
def join(head: IntArray, row: int, other: int) -> None:
    """Makes one cluster of those of two rows; on the way the chains of heads (N,) get shorter."""
    a, b = row, other
    while head[a] != a:
        head[a] = head[head[a]]
        a = head[a]
    while head[b] != b:
        head[b] = head[head[b]]
        b = head[b]
    head[max(a, b)] = min(a, b)


@jit
def cut_out(
    problem: Sparse, columns: int, head: IntArray, first: int
) -> tuple[Sparse, IntArray, IntArray]:
    """A cluster as a problem of its own.

    Args:
        problem: all rows.
        columns: of it, the idle column not among them.
        head: (N,) first row of the cluster of each row.
        first: row of the cluster wanted.

    Returns:
        The problem, and the numbers that its n rows (n,) and m + 1 columns (m + 1,) had; NONE for
        the idle column.
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
