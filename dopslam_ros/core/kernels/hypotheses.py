"""Local weights and global hypotheses: which path came from which landmark, and of which type."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dopslam_ros.core.arrays import FloatArray, IntArray
from dopslam_ros.core.kernels.assignment import insert
from dopslam_ros.core.kernels.compiled import compiled
from dopslam_ros.core.kernels.matching import FREE


@compiled
def log_add(a: float, b: float) -> float:
    """ln(e^a + e^b); either may be -inf."""
    high, low = max(a, b), min(a, b)
    return high if low == -math.inf else high + math.log1p(math.exp(low - high))


@compiled
def log_of(value: float, least: float) -> float:
    """ln(value), but not less than ``least``."""
    return max(math.log(value), least) if value > 0.0 else least


@compiled
def weigh_locally(
    component_track: IntArray,
    type_weight: FloatArray,
    existence: FloatArray,
    detection: FloatArray,
    log_likelihood: FloatArray,
    log_clutter: FloatArray,
    log_births: FloatArray,
    least: float,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Local weights, eqs. (22)-(24) of Ge et al. 2022; the BS exists and is of one type.

    Args:
        component_track: (C,) track of each component.
        type_weight: (C,) probabilities of the components' types.
        existence: (T,) of the tracks.
        detection: (C + 1,) p_D.
        log_likelihood: (C + 1, J).
        log_clutter: (J,) ln c.
        log_births: (B, J) parts of ln rho.
        least: no misdetection and no new landmark weighs less.

    Returns:
        (C + 1, J), (T + 1, J), (T + 1,) and (J,): the fields of LocalWeights.
    """
    sources, paths = log_likelihood.shape
    source, track = np.empty((sources, paths)), np.empty((len(existence) + 1, paths))
    missed, new = np.zeros(len(track)), np.empty(paths)
    for t in range(len(track)):
        for j in range(paths):
            track[t, j] = -math.inf
    for s in range(sources):
        t, exists, share = 0, 1.0, 1.0
        if s > 0:
            t = component_track[s - 1] + 1
            exists, share = existence[t - 1], type_weight[s - 1]
        missed[t] += share * (1.0 - detection[s])
        prior = log_of(exists * share * detection[s], -math.inf)
        for j in range(paths):
            source[s, j] = prior + log_likelihood[s, j]
            track[t, j] = log_add(track[t, j], source[s, j])
    for t in range(len(track)):
        exists = existence[t - 1] if t > 0 else 1.0
        missed[t] = log_of(1.0 - exists + exists * missed[t], least)
    for j in range(paths):
        new[j] = log_clutter[j]
        for b in range(len(log_births)):
            new[j] = log_add(new[j], log_births[b, j])
        new[j] = max(new[j], least)
    return source, track, missed, new


class Choices(NamedTuple):
    """The sources that each path of an association may have come from, the likeliest first.

    Attributes:
        number: (J,) how many.
        cost: (J, n) -ln of their share in the path's track.
        source: (J, n) or FREE.
    """

    number: IntArray
    cost: FloatArray
    source: IntArray


class Kept(NamedTuple):
    """The H best hypotheses so far.

    Attributes:
        found: (1,) how many there are.
        cost: (H,) -ln of their weights, ascending.
        ticket: (H,) which of the following a cost belongs to.
        association: (H,) of which it is a part.
        source: (H, J) of each path, or FREE.
    """

    found: IntArray
    cost: FloatArray
    ticket: IntArray
    association: IntArray
    source: IntArray


@compiled
def choose(
    columns: IntArray,
    source: FloatArray,
    track: FloatArray,
    first: IntArray,
    most_cost: float,
    splits: int,
    choices: Choices,
) -> None:
    """Fills in the choices of an association.

    Args:
        columns: (J,) the track of each path, or FREE.
        source: (C + 1, J) as in LocalWeights.
        track: (T + 1, J) as in LocalWeights.
        first: (T + 2,) the sources of track t are first[t] ... first[t + 1] - 1.
        most_cost: choices less likely than that are left out, except for the likeliest.
        splits: so many of the paths have a choice, those whose second choice is the likeliest;
            the others get their first.
        choices: filled in.
    """
    clear, path, split = np.empty(splits), np.empty(splits, np.int64), np.zeros(1, np.int64)
    for j in range(len(columns)):
        count = choices.number[j : j + 1]
        count[0] = 0
        t = columns[j]
        if t == FREE:
            count[0] = 1
            choices.cost[j, 0] = 0.0
            choices.source[j, 0] = FREE
            continue
        for s in range(first[t + 1] - 1, first[t] - 1, -1):
            insert(choices.cost[j], choices.source[j], count, track[t, j] - source[s, j], s)
        while count[0] > 1 and not choices.cost[j, count[0] - 1] < most_cost:
            count[0] -= 1
        if count[0] > 1:
            insert(clear, path, split, choices.cost[j, 1], j)
    for j in range(len(columns)):
        splitting = False
        for i in range(split[0]):
            splitting = splitting or path[i] == j
        if not splitting:
            choices.number[j] = 1


@compiled
def keep_best(association: int, cost: float, choices: Choices, kept: Kept) -> None:
    """Adds an association once per combination of its choices, where there is room for it."""
    paths, size = len(choices.number), len(kept.cost)
    digit = np.zeros(paths, np.int64)
    turn = 0
    while turn >= 0:
        total = cost
        for j in range(paths):
            total += choices.cost[j, digit[j]]
        if kept.found[0] < size or total < kept.cost[size - 1]:
            at = kept.found[0] if kept.found[0] < size else kept.ticket[size - 1]
            kept.association[at] = association
            for j in range(paths):
                kept.source[at, j] = choices.source[j, digit[j]]
            insert(kept.cost, kept.ticket, kept.found, total, at)
        turn = paths - 1
        while turn >= 0 and digit[turn] + 1 == choices.number[turn]:
            digit[turn] = 0
            turn -= 1
        if turn >= 0:
            digit[turn] += 1


@compiled
def normalised(columns: IntArray, kept: Kept) -> tuple[IntArray, IntArray, FloatArray, float]:
    """The hypotheses kept of associations (A, J), as ``split_by_type`` returns them."""
    count, paths = kept.found[0], columns.shape[1]
    track, source = np.empty((count, paths), np.int64), np.empty((count, paths), np.int64)
    weight = np.empty(count)
    total = 0.0
    for h in range(count):
        at = kept.ticket[h]
        for j in range(paths):
            track[h, j] = columns[kept.association[at], j]
            source[h, j] = kept.source[at, j]
        weight[h] = math.exp(kept.cost[0] - kept.cost[h])
        total += weight[h]
    for h in range(count):
        weight[h] /= total
    return track, source, weight, math.log(total) - kept.cost[0] if count > 0 else -math.inf


@compiled
def split_by_type(
    columns: IntArray,
    costs: FloatArray,
    component_track: IntArray,
    source: FloatArray,
    track: FloatArray,
    gamma: int,
    most_cost: float,
    splits: int,
) -> tuple[IntArray, IntArray, FloatArray, float]:
    """The gamma best hypotheses: associations, each as often as its landmarks may differ in type.

    Args:
        columns: (A, J) the track of each path in each association, 0 the BS, or FREE.
        costs: (A,) -ln of their weights, ascending.
        component_track: (C,) track of each component, ascending.
        source: (C + 1, J) as in LocalWeights.
        track: (T + 1, J) as in LocalWeights.
        gamma: how many at most.
        most_cost: -ln of the smallest share of a source in its track.
        splits: most paths of an association that split by source.

    Returns:
        (H, J) tracks, (H, J) sources and (H,) normalised weights of the hypotheses, and ln of the
        sum of the weights before.
    """
    rows, paths = track.shape
    first = np.zeros(rows + 1, np.int64)
    first[1] = 1  # the BS
    for c in range(len(component_track)):
        first[component_track[c] + 2] += 1
    most = 1
    for t in range(rows):
        most = max(most, first[t + 1])
        first[t + 1] += first[t]
    choices = Choices(
        np.empty(paths, np.int64), np.empty((paths, most)), np.empty((paths, most), np.int64)
    )
    kept = Kept(
        np.zeros(1, np.int64),
        np.empty(gamma),
        np.empty(gamma, np.int64),
        np.empty(gamma, np.int64),
        np.empty((gamma, paths), np.int64),
    )
    for a in range(len(costs)):
        if kept.found[0] == gamma and costs[a] >= kept.cost[gamma - 1]:
            break  # splitting only makes it less likely
        choose(columns[a], source, track, first, most_cost, splits, choices)
        keep_best(a, costs[a], choices, kept)
    return normalised(columns, kept)
