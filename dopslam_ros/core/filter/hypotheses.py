"""Global hypotheses of one step: which path came from which landmark, and of which type it is."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from dopslam_ros.core.arrays import FloatArray, IntArray
from dopslam_ros.core.assignment import k_best_assignments
from dopslam_ros.core.filter.birth import Births
from dopslam_ros.core.filter.evidence import Evidence, Observed
from dopslam_ros.core.filter.state import FilterParameters, FilterState
from dopslam_ros.core.kernels import hypotheses as kernels
from dopslam_ros.core.model import log_clutter_intensity

# A type with less than this share of a detection gets no hypothesis of its own.
SMALLEST_SHARE = 1e-3
# At most this many landmarks of open type split an association: 2^4 combinations.
MOST_SPLITS = 4
# ln of a weight that is as good as zero but can still be compared: what cannot be missed, or what
# nothing explains, must still go somewhere.
LOG_TINY = -700.0


@dataclass(frozen=True)
class LocalWeights:
    """Logarithms of the local weights, eqs. (22)-(24) of Ge et al. 2022.

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


@dataclass(frozen=True)
class Hypotheses:
    """H global hypotheses, the likeliest first.

    Attributes:
        track: (H, J) what each path was given to: 0 the BS, t + 1 track t, or UNASSIGNED (clutter
            or new).
        source: (H, J) the same by component: 0 the BS, c + 1 component c, or UNASSIGNED.
        weight: (H,) normalised.
        log_evidence: ln of the sum of the weights before normalisation: how well the density of
            which these are the continuations foresaw the set.
    """

    track: IntArray
    source: IntArray
    weight: FloatArray
    log_evidence: float


def local_weights(
    state: FilterState,
    observed: Observed,
    evidence: Evidence,
    births: Births,
    parameters: FilterParameters,
) -> LocalWeights:
    """Weights of every path-landmark pair, of misdetections and of new landmarks."""
    return LocalWeights(
        *kernels.weigh_locally(
            np.ascontiguousarray(state.component_track),
            np.ascontiguousarray(state.component_weight),
            np.ascontiguousarray(state.existence),
            np.ascontiguousarray(evidence.detection),
            np.ascontiguousarray(evidence.log_likelihood),
            log_clutter_intensity(parameters, observed.used),
            np.ascontiguousarray(births.log_intensity),
            LOG_TINY,
        )
    )


def associate(
    state: FilterState, weights: LocalWeights, parameters: FilterParameters
) -> Hypotheses:
    """The gamma best associations, those with landmarks of open type split by type.

    The cost of giving path j to track i is -ln(w_ij / w_i0), to a new track -ln w_new,j.
    """
    cost = weights.missed - weights.track.T
    ranked = k_best_assignments(cost, -weights.new, parameters.gamma)
    track, source, weight, log_sum = kernels.split_by_type(
        ranked.columns,
        ranked.costs,
        np.ascontiguousarray(state.component_track),
        np.ascontiguousarray(weights.source),
        np.ascontiguousarray(weights.track),
        parameters.gamma,
        -math.log(SMALLEST_SHARE),
        MOST_SPLITS,
    )
    return Hypotheses(track, source, weight, log_sum + float(weights.missed.sum()))
