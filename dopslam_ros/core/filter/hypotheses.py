"""Global hypotheses of one step: which path came from which landmark, and of which type it is."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from dopslam_ros.core.arrays import FloatArray, IntArray
from dopslam_ros.core.assignment import UNASSIGNED, k_best_assignments
from dopslam_ros.core.filter.birth import Births
from dopslam_ros.core.filter.evidence import Evidence, Observed, source_tracks
from dopslam_ros.core.filter.state import FilterParameters, FilterState
from dopslam_ros.core.model import log_clutter_intensity

# A type with less than this share of a detection gets no hypothesis of its own.
SMALLEST_SHARE = 1e-3
# At most this many landmarks of open type split an association: 2^4 combinations.
MOST_SPLITS = 4
# ln of a weight that is as good as zero but can still be compared.
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
    tracks = source_tracks(state)
    count = len(state.track_id) + 1
    existence = np.concatenate([[1.0], state.existence])
    type_weight = np.concatenate([[1.0], state.component_weight])
    unseen = np.bincount(tracks, type_weight * (1.0 - evidence.detection), minlength=count)
    with np.errstate(divide="ignore"):
        prior = np.log(existence[tracks] * type_weight * evidence.detection)
        missed = np.log(1.0 - existence + existence * unseen)
    source = prior[:, None] + evidence.log_likelihood
    track = np.full((count, source.shape[1]), -np.inf)
    np.logaddexp.at(track, tracks, source)
    new = np.logaddexp(
        log_clutter_intensity(parameters, observed.used), logsumexp(births.log_intensity, axis=0)
    )
    # A landmark that cannot be missed, or a path that nothing explains, must still go somewhere.
    return LocalWeights(source, track, np.maximum(missed, LOG_TINY), np.maximum(new, LOG_TINY))


def associate(
    state: FilterState, weights: LocalWeights, parameters: FilterParameters
) -> Hypotheses:
    """The gamma best associations, those with landmarks of open type split by type.

    The cost of giving path j to track i is -ln(w_ij / w_i0), to a new track -ln w_new,j.
    """
    paths = weights.track.shape[1]
    gain = weights.track - weights.missed[:, None]
    tracks = source_tracks(state)
    ranked = k_best_assignments(-gain.T, -weights.new, parameters.gamma)
    candidates = [
        (-cost + log_share, columns, sources)
        for columns, cost in zip(ranked.columns, ranked.costs, strict=True)
        for log_share, sources in _type_splits(columns, weights, tracks)
    ]
    candidates.sort(key=lambda candidate: -candidate[0])
    kept = candidates[: parameters.gamma]
    log_weight = np.array([candidate[0] for candidate in kept])
    log_sum = float(logsumexp(log_weight))
    return Hypotheses(
        track=np.array([c[1] for c in kept], dtype=np.int64).reshape(len(kept), paths),
        source=np.array([c[2] for c in kept], dtype=np.int64).reshape(len(kept), paths),
        weight=np.exp(log_weight - log_sum),
        log_evidence=log_sum + float(weights.missed.sum()),
    )


def _type_splits(
    columns: IntArray, weights: LocalWeights, tracks: IntArray
) -> Iterator[tuple[float, IntArray]]:
    """An association once per combination of types, each with the ln of its share."""
    options: list[list[tuple[float, int]]] = []
    for path, track in enumerate(columns):
        if track == UNASSIGNED:
            options.append([(0.0, UNASSIGNED)])
            continue
        members = np.flatnonzero(tracks == track)
        shares = weights.source[members, path] - weights.track[track, path]
        choices = sorted(zip(shares.tolist(), members.tolist(), strict=True), reverse=True)
        options.append([c for c in choices if c[0] > np.log(SMALLEST_SHARE)])
    # The least clear ones split; the others take their likeliest type.
    runner_up = [choices[1][0] if len(choices) > 1 else -np.inf for choices in options]
    split = set(np.argsort(runner_up)[::-1][:MOST_SPLITS].tolist())
    for combination in itertools.product(
        *(choices if path in split else choices[:1] for path, choices in enumerate(options))
    ):
        yield (
            sum(share for share, _ in combination),
            np.array([source for _, source in combination], dtype=np.int64),
        )
