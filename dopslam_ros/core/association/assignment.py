"""The k best assignments of rows to columns, as Python calls them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dopslam_ros.core.association.murty import k_best
from dopslam_ros.core.linalg.arrays import FloatArray, IntArray


class Assignments(NamedTuple):
    """Assignments in the order of their cost.

    Attributes:
        columns: (k, R) the column of each row, or NONE.
        costs: (k,) ascending.
    """

    columns: IntArray
    costs: FloatArray


def k_best_assignments(cost: FloatArray, idle_cost: FloatArray, k: int) -> Assignments:
    """The k cheapest ways to give rows to columns, no column twice, any row may stay idle.

    Of equally cheap ones always the same come out, in the same order.

    Args:
        cost: (R, C) of giving a row to a column; not finite where that is ruled out (gated).
        idle_cost: (R,) of a row that gets no column; not finite where it must get one.
        k: how many at most.

    Returns:
        Up to k assignments; none when no assignment is possible.

    Raises:
        ValueError: the shapes do not fit together.
    """
    cost = np.ascontiguousarray(cost, dtype=np.float64)
    idle_cost = np.ascontiguousarray(idle_cost, dtype=np.float64)
    if cost.ndim != 2 or idle_cost.shape != cost.shape[:1]:
        raise ValueError(
            f"costs of shape {cost.shape} with idle costs of shape {idle_cost.shape}:"
            " give (R, C) and (R,)"
        )
    return Assignments(*k_best(cost, idle_cost, k))
