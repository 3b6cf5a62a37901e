"""The lists that the best assignments are kept in."""

from __future__ import annotations

import numpy as np
import pytest

from dopslam_ros.core.association import sorted_list
from dopslam_ros.core.linalg.jit import from_python

smallest_sums = from_python(sorted_list.smallest_sums)
insert = from_python(sorted_list.insert)


@pytest.mark.parametrize("size", [1, 3, 8, 30])
def test_a_list_keeps_the_smallest_in_order_the_first_of_equals_first(size: int) -> None:
    rng = np.random.default_rng(size)
    keys, tickets, count = np.empty(size), np.empty(size, np.int64), np.zeros(1, np.int64)
    offered = rng.integers(0, 9, 20).astype(float)
    for ticket, key in enumerate(offered.tolist()):
        insert(keys, tickets, count, key, ticket)
    order = np.argsort(offered, kind="stable")[:size]
    assert count[0] == len(order)
    np.testing.assert_array_equal(tickets[: count[0]], order)
    np.testing.assert_array_equal(keys[: count[0]], offered[order])


@pytest.mark.parametrize("k", [1, 2, 5, 17, 1000])
def test_the_smallest_sums_are_those_of_all_sums(k: int) -> None:
    rng = np.random.default_rng(k)
    for _ in range(20):
        one = np.sort(rng.integers(0, 6, rng.integers(1, 9)).astype(float))
        other = np.sort(rng.integers(0, 6, rng.integers(1, 9)).astype(float))
        every = (one[:, None] + other).ravel()
        sums, tickets = smallest_sums(one, other, k)
        np.testing.assert_array_equal(sums, np.sort(every)[:k])
        np.testing.assert_array_equal(every[tickets], sums)
        assert len(set(tickets.tolist())) == len(tickets)
