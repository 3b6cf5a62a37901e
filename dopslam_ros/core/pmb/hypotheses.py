"""Local weights and global hypotheses: which path came from which landmark, and of which type."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dopslam_ros.core.association.murty import k_best
from dopslam_ros.core.association.sorted_list import insert
from dopslam_ros.core.linalg.arrays import FloatArray, IntArray
from dopslam_ros.core.linalg.jit import jit, jit_inline
from dopslam_ros.core.pmb.birth import Births
from dopslam_ros.core.pmb.density import Density
from dopslam_ros.core.pmb.likelihood import Likelihoods, Observed
from dopslam_ros.core.settings.filtering import Constants
from dopslam_ros.core.settings.layout import NONE

# A type with less than this share of a detection gets no hypothesis of its own.
SMALLEST_SHARE = 1e-3
# At most this many landmarks of open type split an association: 2^4 combinations.
MOST_SPLITS = 4
# ln of a weight that is as good as zero but can still be compared: what cannot be missed, or what
# nothing explains, must still go somewhere.
LOG_TINY = -700.0
LOG_SMALLEST = -math.log(SMALLEST_SHARE)


@jit
def log_add(a: float, b: float) -> float:
    """ln(e^a + e^b); either may be -inf."""
    high, low = max(a, b), min(a, b)
    return high if low == -math.inf else high + math.log1p(math.exp(low - high))


@jit
def log_of(value: float, least: float) -> float:
    """ln(value), but not less than ``least``."""
    return max(math.log(value), least) if value > 0.0 else least


@jit_inline
def local_weights(
    density: Density,
    observed: Observed,
    likelihoods: Likelihoods,
    births: Births,
    constants: Constants,
) -> LocalWeights:
    """Weights of every path-landmark pair, of misdetections and of new landmarks.

    EK-PMBM eqs. (22)-(24). The BS exists and is of one type.
    """
    component_track, type_weight = density.component_track, density.component_weight
    existence, detection, least = density.existence, likelihoods.detection, LOG_TINY
    log_likelihood, log_births = likelihoods.log_likelihood, births.log_intensity
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
        new[j] = constants.log_clutter_mean
        for k in range(observed.used.shape[1]):
            if observed.used[j, k]:
                new[j] -= constants.clutter_log_spans[k]
        for b in range(len(log_births)):
            new[j] = log_add(new[j], log_births[b, j])
        new[j] = max(new[j], least)
    return LocalWeights(source, track, missed, new)


class Choices(NamedTuple):
    """The sources that each path of an association may have come from, the likeliest first.

    Attributes:
        number: (J,) how many.
        cost: (J, n) -ln of their share in the path's track.
        source: (J, n) or NONE.
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
        source: (H, J) of each path, or NONE.
    """

    found: IntArray
    cost: FloatArray
    ticket: IntArray
    association: IntArray
    source: IntArray


@jit
def choose(
    columns: IntArray,
    source: FloatArray,
    track: FloatArray,
    first: IntArray,
    choices: Choices,
) -> None:
    """Fills in the choices of an association: of few paths, those whose second is the likeliest.

    Args:
        columns: (J,) the track of each path, or NONE.
        source: (C + 1, J) as in LocalWeights.
        track: (T + 1, J) as in LocalWeights.
        first: (T + 2,) the sources of track t are first[t] ... first[t + 1] - 1.
        choices: filled in.
    """
    clear, path = np.empty(MOST_SPLITS), np.empty(MOST_SPLITS, np.int64)
    split = np.zeros(1, np.int64)
    for j in range(len(columns)):
        count = choices.number[j : j + 1]
        count[0] = 0
        t = columns[j]
        if t == NONE:
            count[0] = 1
            choices.cost[j, 0] = 0.0
            choices.source[j, 0] = NONE
            continue
        for s in range(first[t + 1] - 1, first[t] - 1, -1):
            insert(choices.cost[j], choices.source[j], count, track[t, j] - source[s, j], s)
        while count[0] > 1 and not choices.cost[j, count[0] - 1] < LOG_SMALLEST:
            count[0] -= 1
        if count[0] > 1:
            insert(clear, path, split, choices.cost[j, 1], j)
    for j in range(len(columns)):
        splitting = False
        for i in range(split[0]):
            splitting = splitting or path[i] == j
        if not splitting:
            choices.number[j] = 1


@jit
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


@jit
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


@jit
def split_by_type(
    columns: IntArray,
    costs: FloatArray,
    component_track: IntArray,
    source: FloatArray,
    track: FloatArray,
    gamma: int,
) -> tuple[IntArray, IntArray, FloatArray, float]:
    """The gamma best hypotheses: associations, each as often as its landmarks may differ in type.

    Args:
        columns: (A, J) the track of each path in each association, 0 the BS, or NONE.
        costs: (A,) -ln of their weights, ascending.
        component_track: (C,) track of each component, ascending.
        source: (C + 1, J) as in LocalWeights.
        track: (T + 1, J) as in LocalWeights.
        gamma: how many at most.

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
        choose(columns[a], source, track, first, choices)
        keep_best(a, costs[a], choices, kept)
    return normalised(columns, kept)


@jit_inline
def associate(component_track: IntArray, weights: LocalWeights, gamma: int) -> Hypotheses:
    """The gamma best associations, those with landmarks of open type split by type.

    Their weights are products of local weights, EK-PMBM eq. (29). So the cost of giving
    path j to track i is -ln(w_ij / w_i0), and to a new track -ln w_new,j.

    Args:
        component_track: (C,) track of each component, ascending.
        weights: of the pairs.
        gamma: how many at most.
    """
    tracks, paths = weights.track.shape
    cost, missed = np.empty((paths, tracks)), 0.0
    for t in range(tracks):
        missed += weights.missed[t]
        for j in range(paths):
            cost[j, t] = weights.missed[t] - weights.track[t, j]
    columns, costs = k_best(cost, -weights.new, gamma)
    if len(costs) == 0:  # what is not a number cannot be ranked
        columns, costs, missed = np.full((1, paths), NONE), np.zeros(1), math.nan
    track, source, weight, log_sum = split_by_type(
        columns, costs, component_track, weights.source, weights.track, gamma
    )
    return Hypotheses(track, source, weight, log_sum + missed)


class LocalWeights(NamedTuple):
    """Logarithms of the local weights, EK-PMBM eqs. (22)-(24).

    Attributes:
        source: (C + 1, J) detected by path j as source (0 the BS, then components): r u p_D N.
        track: (T + 1, J) the same, summed over the types of each track; row 0 is the BS.
        missed: (T + 1,) 1 - r + r q, q the probability of a misdetection.
        new: (J,) c + rho: the path is clutter or a landmark never detected before.
    """

    source: FloatArray
    track: FloatArray
    missed: FloatArray
    new: FloatArray


class Hypotheses(NamedTuple):
    """H global hypotheses, the likeliest first.

    Attributes:
        track: (H, J) what each path was given to: 0 the BS, t + 1 track t, or NONE (clutter or
            new).
        source: (H, J) the same by component: 0 the BS, c + 1 component c, or NONE.
        weight: (H,) normalised.
        log_evidence: ln of the sum of the weights before normalisation: how well the density of
            which these are the continuations foresaw the set.
    """

    track: IntArray
    source: IntArray
    weight: FloatArray
    log_evidence: float
