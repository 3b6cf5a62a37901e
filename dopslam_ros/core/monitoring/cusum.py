"""What a set says of whether the filter still knows where it is: the terms of Page's test."""

from __future__ import annotations

import math
from typing import NamedTuple

from dopslam_ros.core.linalg.arrays import FloatArray, IntArray
from dopslam_ros.core.linalg.jit import from_python
from dopslam_ros.core.settings.layout import BS_ID, NONE

# Of a lost vehicle, the share of the paths that fall into the gate of a landmark by chance.
BY_CHANCE = 0.1
# No landmark is so sure to be heard that to miss it once would say more than this.
SUREST = 0.95
# Nor does a path that nothing explains say more than this [nat].
MOST_OF_A_PATH = 3.0


class SetStatistics(NamedTuple):
    """The statistics of one set.

    Attributes:
        expected: number of sources that were to be heard.
        variance: of that number.
        heard: number of them that were.
        clutter: number of paths that are clutter.
        line_of_sight: probability that the BS was heard.
        log_odds: ln p(set | lost) - ln p(set | found).
    """

    expected: float
    variance: float
    heard: float
    clutter: float
    line_of_sight: float
    log_odds: float


@from_python
def set_statistics(
    ids: IntArray,
    weight: FloatArray,
    sources: IntArray,
    log_missed: FloatArray,
    log_new: FloatArray,
    log_uniform: FloatArray,
    clutter_mean: float,
) -> SetStatistics:
    """Expected and heard, and the odds of lost against found.

    Found, source t is heard with probability p_t and a path that is no source's has the intensity
    c + rho. Lost, it is heard by chance only, and the paths of all sources are uniform, as clutter.

    Args:
        ids: (H, J) landmark of each path under each hypothesis, or NONE.
        weight: (H,) of the hypotheses.
        sources: (S,) ids of what could be heard.
        log_missed: (S,) ln of the probability that it is not.
        log_new: (J,) ln (c + rho).
        log_uniform: (J,) ln of the density of a path that may be anything.
        clutter_mean: mean number of clutter paths.
    """
    expected, variance, heard, log_odds, line_of_sight = 0.0, 0.0, 0.0, 0.0, 0.0
    for t in range(len(sources)):
        p = min(1.0 - math.exp(log_missed[t]), SUREST)
        share = 0.0
        for h in range(ids.shape[0]):
            for j in range(ids.shape[1]):
                if ids[h, j] == sources[t]:
                    share += weight[h]
        expected += p
        variance += p * (1.0 - p)
        heard += share
        if sources[t] == BS_ID:
            line_of_sight = share
        log_odds += share * math.log(BY_CHANCE)
        log_odds += (1.0 - share) * math.log((1.0 - BY_CHANCE * p) / (1.0 - p))
    clutter = 0.0
    for j in range(ids.shape[1]):
        free = 0.0
        for h in range(ids.shape[0]):
            if ids[h, j] == NONE:
                free += weight[h]
        # Of what is free, the share of clutter is c / (c + rho).
        if clutter_mean > 0.0:
            clutter += free * clutter_mean * math.exp(log_uniform[j] - log_new[j])
        surprise = math.log(clutter_mean + expected + BY_CHANCE) + log_uniform[j] - log_new[j]
        log_odds += free * min(surprise, MOST_OF_A_PATH)
    return SetStatistics(expected, variance, heard, clutter, line_of_sight, log_odds - expected)
