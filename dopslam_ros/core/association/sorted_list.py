"""Lists of fixed size that keep the smallest keys in order."""

from __future__ import annotations

import numpy as np

from dopslam_ros.core.linalg.arrays import FloatArray, IntArray
from dopslam_ros.core.linalg.jit import jit


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


@jit
def smallest_sums(one: FloatArray, other: FloatArray, k: int) -> tuple[FloatArray, IntArray]:
    """The k smallest sums of a number of ``one`` (A,) and one of ``other`` (B,), both ascending.

    Returns:
        (H,) sums, ascending, and (H,) tickets a B + b.
    """
    size = min(k, len(one) * len(other))
    sums = np.empty(size)
    tickets = np.empty(size, np.int64)
    count = np.zeros(1, np.int64)
    for a in range(len(one)):
        # (a + 1) (b + 1) - 1 sums are no larger than that of a and b.
        for b in range(min(len(other), k // (a + 1))):
            value = one[a] + other[b]
            if count[0] == size and value >= sums[size - 1]:
                break
            insert(sums, tickets, count, value, a * len(other) + b)
    return sums, tickets
