"""The Gaussian part of a step: augment with births, update per hypothesis, merge to one density."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from dopslam_ros.core.arrays import BoolArray, FloatArray, IntArray
from dopslam_ros.core.assignment import UNASSIGNED
from dopslam_ros.core.filter import placement
from dopslam_ros.core.filter.birth import Births
from dopslam_ros.core.filter.evidence import Evidence, Observed
from dopslam_ros.core.filter.hypotheses import Hypotheses, LocalWeights
from dopslam_ros.core.filter.state import UE, UNKNOWN_TYPES, FilterParameters, FilterState
from dopslam_ros.core.kernels import update as kernels

_UNKNOWN = np.array(UNKNOWN_TYPES)


@dataclass(frozen=True)
class Outcomes:
    """What each hypothesis says of each landmark.

    Attributes:
        existence: (H, T) probability that the track exists.
        type_weight: (H, C) probability of the component's type, given that the track exists.
    """

    existence: FloatArray
    type_weight: FloatArray


class Updated(NamedTuple):
    """The joint vector under each of H hypotheses.

    Attributes:
        means: (H, n).
        covariances: (H, n, n).
        nis: (H,) normalised innovation squared of all paths that are given away, jointly.
    """

    means: FloatArray
    covariances: FloatArray
    nis: FloatArray


@dataclass(frozen=True)
class Augmented:
    """The state with a track per path that may be a new landmark, under every hypothesis.

    Attributes:
        state: tracks and components of the births appended; its Gaussian is that of the first
            hypothesis.
        means: (H, n) of the joint vector under each hypothesis.
        covariances: (H, n, n).
        birth_track: (J,) track of the landmark born from path j, or UNASSIGNED.
    """

    state: FilterState
    means: FloatArray
    covariances: FloatArray
    birth_track: IntArray


@dataclass(frozen=True)
class Newborn:
    """The landmarks that may be born from J paths.

    Attributes:
        existence: (J,) r = rho / (c + rho), where the path is given to no landmark.
        kept: (J,) whose landmark would not be pruned at once.
    """

    existence: FloatArray
    kept: BoolArray


def newborn(
    births: Births, weights: LocalWeights, hypotheses: Hypotheses, parameters: FilterParameters
) -> Newborn:
    """Which births are worth keeping."""
    count = len(weights.new)
    existence, kept = np.empty(count), np.empty(count, np.bool_)
    kernels.birth_existences(
        births.log_intensity,
        weights.new,
        hypotheses.weight,
        hypotheses.track,
        parameters.prune_existence,
        existence,
        kept,
    )
    return Newborn(existence, kept)


def condition(
    state: FilterState, observed: Observed, evidence: Evidence, hypotheses: Hypotheses
) -> Updated:
    """One joint EKF update of [s; q_1 ... q_C] per hypothesis.

    Raises:
        LinAlgError: an innovation's covariance is not positive definite.
    """
    source = hypotheses.source
    rows, n = len(source), len(state.mean)
    # What most hypotheses agree on comes first, so that they share it.
    agree = (source == source[:1]).sum(axis=0)
    path_order = np.argsort(-agree, kind="stable")
    row_order = np.lexsort(source[:, path_order[::-1]].T) if source.size else np.arange(rows)
    updated = Updated(np.empty((rows, n)), np.empty((rows, n, n)), np.empty(rows))
    if not kernels.condition(
        state.mean,
        state.covariance,
        evidence.ue_jacobian,
        evidence.landmark_jacobian,
        evidence.innovation,
        observed.used,
        observed.noise,
        source,
        path_order,
        row_order,
        *updated,
    ):
        raise np.linalg.LinAlgError("an innovation's covariance is not positive definite")
    return updated


def augment(
    state: FilterState,
    means: FloatArray,
    covariances: FloatArray,
    births: Births,
    born: Newborn,
    numbered: BoolArray,
    parameters: FilterParameters,
) -> Augmented:
    """Appends the births that are kept, each correlated with the vehicle as its fit says.

    Args:
        state: predicted, to which the births were fitted.
        means: (H, n) under each hypothesis.
        covariances: (H, n, n).
        births: candidates from J paths.
        born: which are kept.
        numbered: (J,) births that get an id, those kept among them: global hypotheses share ids.
        parameters: pruning of types.
    """
    paths = len(numbered)
    if not numbered.any():
        alone = replace(state, mean=means[0], covariance=covariances[0])
        return Augmented(alone, means, covariances, np.full(paths, UNASSIGNED))
    path, kind = np.empty((2, 2 * paths), np.int64)
    share = np.empty(2 * paths)
    count = kernels.select_births(
        births.log_intensity, born.kept, parameters.prune_type, path, kind, share
    )
    path, kind, share = path[:count], kind[:count], share[:count]
    which = np.cumsum(born.kept) - 1  # number of each path's birth
    tracks = len(state.track_id)
    origin = np.empty((count, 3))
    origin[:, :2] = state.mean[:2]
    origin[:, 2] = parameters.ue_height
    axes = placement.frames(births.position[kind, path] - origin)
    more_means, more_covariances = _append(
        state,
        means,
        covariances,
        axes,
        np.ascontiguousarray(births.position[kind, path]),
        np.ascontiguousarray(births.covariance[kind, path]),
        np.ascontiguousarray(births.gain[kind, path]),
        parameters.ue_height,
    )
    birth_track = np.where(born.kept, tracks + which, UNASSIGNED)
    ids = state.next_id + np.cumsum(numbered) - 1
    augmented = replace(
        state,
        mean=more_means[0],
        covariance=more_covariances[0],
        origin=np.concatenate([state.origin, origin]),
        axes=np.concatenate([state.axes, axes]),
        component_track=np.concatenate([state.component_track, birth_track[path]]),
        component_type=np.concatenate([state.component_type, _UNKNOWN[kind]]),
        component_weight=np.concatenate([state.component_weight, share]),
        track_id=np.concatenate([state.track_id, ids[born.kept]]),
        existence=np.concatenate([state.existence, born.existence[born.kept]]),
        next_id=state.next_id + int(numbered.sum()),
    )
    return Augmented(augmented, more_means, more_covariances, birth_track)


def _append(
    state: FilterState,
    means: FloatArray,
    covariances: FloatArray,
    axes: FloatArray,
    positions: FloatArray,
    covariances_given: FloatArray,
    gains: FloatArray,
    ue_height: float,
) -> tuple[FloatArray, FloatArray]:
    """The Gaussians with births (B, 3), (B, 3, 3), (B, 3, 4), given in x, y, z, behind the rest."""
    if not len(positions):
        return means, covariances
    births, rows = len(positions), len(means)
    q, spread, gain = np.empty((births, 3)), np.empty((births, 3, 3)), np.empty((births, 3, UE))
    kernels.place_births(
        state.ue_mean,
        ue_height,
        state.covariance,
        axes,
        positions,
        covariances_given,
        gains,
        q,
        spread,
        gain,
    )
    n = means.shape[1] + 3 * births
    more_means, more_covariances = np.empty((rows, n)), np.empty((rows, n, n))
    kernels.append(means, covariances, state.ue_mean, q, spread, gain, more_means, more_covariances)
    return more_means, more_covariances


def judge(augmented: Augmented, evidence: Evidence, hypotheses: Hypotheses) -> Outcomes:
    """Existence and type of every landmark under every hypothesis."""
    state, rows = augmented.state, len(hypotheses.weight)
    existence = np.empty((rows, len(state.track_id)))
    type_weight = np.empty((rows, len(state.component_track)))
    kernels.judge(
        evidence.detection,
        state.existence,
        state.component_track,
        state.component_weight,
        augmented.birth_track,
        hypotheses.source,
        existence,
        type_weight,
    )
    return Outcomes(existence, type_weight)


def merge(
    augmented: Augmented,
    outcomes: Outcomes,
    hypotheses: Hypotheses,
    parameters: FilterParameters,
) -> FilterState:
    """PMBM to PMB: moments matched over the hypotheses, block by block.

    The vehicle is weighted by W, a component by W r u: the track-oriented merge that is nearest in
    Kullback-Leibler divergence. Blocks have different weights, so the covariance between two is
    weighted by the geometric mean of theirs; the sum of congruences keeps it positive definite.
    """
    state = augmented.state
    existence, share = np.empty(len(state.track_id)), np.empty(len(state.component_track))
    mean, covariance = np.empty_like(state.mean), np.empty_like(state.covariance)
    kernels.merge(
        hypotheses.weight,
        outcomes.existence,
        outcomes.type_weight,
        state.component_track,
        augmented.means,
        augmented.covariances,
        existence,
        share,
        mean,
        covariance,
    )
    if parameters.coupling == "marginal":
        kernels.uncouple(covariance)
    return replace(
        state, mean=mean, covariance=covariance, component_weight=share, existence=existence
    )


def separate(
    augmented: Augmented, outcomes: Outcomes, parameters: FilterParameters
) -> list[FilterState]:
    """The density under each hypothesis, for a PMBM that carries them on."""
    states = [
        replace(
            augmented.state,
            mean=mean,
            covariance=covariance,
            component_weight=weight,
            existence=existence,
        )
        for mean, covariance, weight, existence in zip(
            augmented.means,
            augmented.covariances,
            outcomes.type_weight,
            outcomes.existence,
            strict=True,
        )
    ]
    if parameters.coupling == "marginal":
        return [_uncoupled(state) for state in states]
    return states


def prune(state: FilterState, parameters: FilterParameters) -> FilterState:
    """Drops landmarks that hardly exist and types that hardly apply."""
    track_kept = state.existence > parameters.prune_existence
    kept = track_kept[state.component_track] & (state.component_weight > parameters.prune_type)
    pruned = state.only(kept, track_kept)
    track, weight = pruned.component_track, pruned.component_weight
    weight = weight / np.bincount(track, weight, minlength=len(pruned.track_id))[track]
    return replace(pruned, component_weight=weight)


def _uncoupled(state: FilterState) -> FilterState:
    """The marginal form of the paper: no covariance between vehicle, landmarks and types."""
    covariance = state.covariance.copy()
    kernels.uncouple(covariance)
    return replace(state, covariance=covariance)
