"""What hypotheses have in common, so that it is computed once."""

from __future__ import annotations

import numpy as np

from dopslam_ros.core.linalg.arrays import IntArray
from dopslam_ros.core.linalg.jit import jit


@jit
def by_agreement(source: IntArray) -> tuple[IntArray, int]:
    """(J,) the paths, those first which many of the hypotheses (H, J) treat as the first one does.

    What most agree on comes first, so that they share it; with how many all agree on.
    """
    rows, paths = source.shape
    agree = np.zeros(paths, np.int64)
    for h in range(rows):
        for j in range(paths):
            agree[j] += source[h, j] == source[0, j]
    order, common = np.empty(paths, np.int64), 0
    for j in range(paths):
        common += agree[j] == rows
        at = j
        while at > 0 and agree[order[at - 1]] < agree[j]:
            order[at] = order[at - 1]
            at -= 1
        order[at] = j
    return order, common


@jit
def in_order(source: IntArray, order: IntArray) -> tuple[IntArray, IntArray]:
    """The hypotheses (H, J) sorted by their sources of the paths in some order.

    Returns:
        (H,) which comes when, and (H,) how many paths in order each has in common with the one
        before.
    """
    rows, paths = source.shape
    sequence, common = np.empty(rows, np.int64), np.zeros(rows, np.int64)
    for h in range(rows):
        at = h
        while at > 0:
            before, depth = sequence[at - 1], 0
            while depth < paths and source[before, order[depth]] == source[h, order[depth]]:
                depth += 1
            if depth == paths or source[before, order[depth]] < source[h, order[depth]]:
                break
            sequence[at] = before
            at -= 1
        sequence[at] = h
    for at in range(1, rows):
        one, other = sequence[at - 1], sequence[at]
        while common[at] < paths and (
            source[one, order[common[at]]] == source[other, order[common[at]]]
        ):
            common[at] += 1
    return sequence, common
