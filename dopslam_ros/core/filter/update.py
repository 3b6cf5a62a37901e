"""The Gaussian part of a step: augment with births, update per hypothesis, merge to one density."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dopslam_ros.core.arrays import BoolArray, FloatArray, IntArray, block_indices, symmetrise
from dopslam_ros.core.assignment import UNASSIGNED
from dopslam_ros.core.channel import DIM
from dopslam_ros.core.filter import placement
from dopslam_ros.core.filter.birth import Births
from dopslam_ros.core.filter.evidence import Evidence, Observed
from dopslam_ros.core.filter.hypotheses import Hypotheses, LocalWeights
from dopslam_ros.core.filter.state import UE, UNKNOWN_TYPES, FilterParameters, FilterState


@dataclass(frozen=True)
class Outcomes:
    """What each hypothesis says of each landmark.

    Attributes:
        existence: (H, T) probability that the track exists.
        type_weight: (H, C) probability of the component's type, given that the track exists.
    """

    existence: FloatArray
    type_weight: FloatArray


@dataclass(frozen=True)
class Augmented:
    """The state with a track per path that may be a new landmark.

    Attributes:
        state: tracks and components of the births appended.
        birth_track: (J,) track of the landmark born from path j, or UNASSIGNED.
    """

    state: FilterState
    birth_track: IntArray


def worth_keeping(
    births: Births, weights: LocalWeights, hypotheses: Hypotheses, parameters: FilterParameters
) -> BoolArray:
    """(J,) whose landmark would not be pruned at once."""
    not_taken = hypotheses.weight @ (hypotheses.track == UNASSIGNED)
    return np.asarray(birth_existence(births, weights) * not_taken > parameters.prune_existence)


def birth_existence(births: Births, weights: LocalWeights) -> FloatArray:
    """(J,) r = rho / (c + rho), where the path is given to no landmark."""
    log_rho = np.logaddexp(births.log_intensity[0], births.log_intensity[1])
    return np.asarray(np.exp(log_rho - weights.new))


def augment(
    state: FilterState,
    births: Births,
    weights: LocalWeights,
    kept: BoolArray,
    numbered: BoolArray,
    parameters: FilterParameters,
) -> Augmented:
    """Appends the births that are kept, each correlated with the vehicle as its fit says.

    Args:
        state: predicted.
        births: candidates from J paths.
        weights: local weights.
        kept: (J,) births to append.
        numbered: (J,) births that get an id, those kept among them: global hypotheses share ids.
        parameters: pruning of types.
    """
    existence = birth_existence(births, weights)
    log_rho = np.logaddexp(births.log_intensity[0], births.log_intensity[1])
    ids = state.next_id + np.cumsum(numbered) - 1
    born = np.flatnonzero(kept)
    share = np.exp(births.log_intensity[:, born] - log_rho[born])
    share[share < parameters.prune_type] = 0.0
    share /= share.sum(axis=0)
    # Sorted by track, then type: (number of the birth, type).
    which, kind = np.nonzero(share.T)
    tracks = len(state.track_id)
    position = births.position[kind, born[which]]
    origin = np.tile(np.append(state.ue_mean[:2], parameters.ue_height), (len(position), 1))
    axes = placement.frames(position - origin)
    q = placement.placements(origin, axes, position)
    to_position = placement.jacobians(axes, q)
    half = np.asarray(np.linalg.solve(to_position, births.covariance[kind, born[which]]))
    spread = np.asarray(np.linalg.solve(to_position, np.swapaxes(half, 1, 2)), np.float64)
    gain = np.asarray(np.linalg.solve(to_position, births.gain[kind, born[which]]), np.float64)
    mean, covariance = _append_components(state, q, symmetrise(spread), gain)
    birth_track = np.full(len(existence), UNASSIGNED, dtype=np.int64)
    birth_track[born] = tracks + np.arange(len(born))
    augmented = replace(
        state,
        mean=mean,
        covariance=covariance,
        origin=np.concatenate([state.origin, origin]),
        axes=np.concatenate([state.axes, axes]),
        component_track=np.concatenate([state.component_track, tracks + which]),
        component_type=np.concatenate([state.component_type, np.array(UNKNOWN_TYPES)[kind]]),
        component_weight=np.concatenate([state.component_weight, share[kind, which]]),
        track_id=np.concatenate([state.track_id, ids[born]]),
        existence=np.concatenate([state.existence, existence[born]]),
        next_id=state.next_id + int(numbered.sum()),
    )
    return Augmented(augmented, birth_track)


def condition(
    augmented: Augmented, observed: Observed, evidence: Evidence, hypotheses: Hypotheses
) -> tuple[FloatArray, FloatArray]:
    """One joint EKF update of [s; x_1 ... x_C] per hypothesis.

    Returns:
        (H, n) means and (H, n, n) covariances.
    """
    state = augmented.state
    taken = np.flatnonzero((hypotheses.source != UNASSIGNED).any(axis=0))
    source = hypotheses.source[:, taken]
    assigned = source != UNASSIGNED
    rows = _measurement_rows(source, assigned, evidence, observed.used[taken], len(state.mean))
    innovation = np.where(
        assigned[:, :, None], evidence.innovation[source, taken[None, :]], 0.0
    ).reshape(len(source), -1)
    noise = np.where(assigned[:, :, None, None], observed.noise[taken], np.eye(DIM))

    projected = rows @ state.covariance
    s = projected @ np.swapaxes(rows, 1, 2)
    for path in range(len(taken)):
        block = slice(DIM * path, DIM * (path + 1))
        s[:, block, block] += noise[:, path]
    factor = np.linalg.cholesky(symmetrise(s))
    white = np.linalg.solve(factor, np.concatenate([projected, innovation[:, :, None]], axis=2))
    gain, white_innovation = np.swapaxes(white[:, :, :-1], 1, 2), white[:, :, -1:]
    mean = state.mean + (gain @ white_innovation)[:, :, 0]
    return mean, symmetrise(state.covariance - gain @ white[:, :, :-1])


def judge(augmented: Augmented, evidence: Evidence, hypotheses: Hypotheses) -> Outcomes:
    """Existence and type of every landmark under every hypothesis."""
    state = augmented.state
    old = len(evidence.detection) - 1
    tracks = len(state.track_id)
    detection = np.zeros(len(state.component_track))
    detection[:old] = evidence.detection[1:]
    surviving = state.component_weight * (1.0 - detection)
    unseen = np.bincount(state.component_track, surviving, minlength=tracks)
    missed = state.existence * unseen
    missed = missed / np.maximum(1.0 - state.existence + missed, 1e-300)

    existence = np.tile(missed, (len(hypotheses.weight), 1))
    type_weight = np.tile(
        surviving / np.maximum(unseen, 1e-300)[state.component_track],
        (len(hypotheses.weight), 1),
    )
    hypothesis, path = np.nonzero(hypotheses.source > 0)
    source = hypotheses.source[hypothesis, path] - 1
    track = state.component_track[source]
    existence[hypothesis, track] = 1.0
    for h, t, c in zip(hypothesis, track, source, strict=True):
        type_weight[h, state.component_track == t] = 0.0
        type_weight[h, c] = 1.0
    for number, born in enumerate(augmented.birth_track.tolist()):
        if born != UNASSIGNED:
            free = hypotheses.source[:, number] == UNASSIGNED
            existence[:, born] = np.where(free, state.existence[born], 0.0)
    return Outcomes(existence, type_weight)


def merge(
    augmented: Augmented,
    means: FloatArray,
    covariances: FloatArray,
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
    component = hypotheses.weight[:, None] * outcomes.type_weight
    component = component * outcomes.existence[:, state.component_track]
    total = component.sum(axis=0)
    existence = hypotheses.weight @ outcomes.existence
    scaled = component / np.where(total > 0.0, total, 1.0)
    # A component that no hypothesis supports is about to be dropped; any weights will do.
    scaled = np.where(total > 0.0, scaled, hypotheses.weight[:, None])
    weight = np.concatenate(
        [np.tile(hypotheses.weight[:, None], UE), np.repeat(scaled, 3, axis=1)], axis=1
    )
    mean = np.sum(weight * means, axis=0)
    root = np.sqrt(weight)
    deviation = root * (means - mean)
    covariance = np.einsum("hi,hij,hj->ij", root, covariances, root)
    covariance += deviation.T @ deviation
    track_total = np.bincount(state.component_track, total, minlength=len(existence))
    share = total / np.where(track_total > 0.0, track_total, 1.0)[state.component_track]
    merged = replace(
        state,
        mean=mean,
        covariance=symmetrise(covariance),
        component_weight=share,
        existence=np.minimum(existence, 1.0),
    )
    return _uncoupled(merged) if parameters.coupling == "marginal" else merged


def separate(
    augmented: Augmented,
    means: FloatArray,
    covariances: FloatArray,
    outcomes: Outcomes,
    parameters: FilterParameters,
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
            means, covariances, outcomes.type_weight, outcomes.existence, strict=True
        )
    ]
    if parameters.coupling == "marginal":
        return [_uncoupled(state) for state in states]
    return states


def prune(state: FilterState, parameters: FilterParameters) -> FilterState:
    """Drops landmarks that hardly exist and types that hardly apply."""
    track_kept = state.existence > parameters.prune_existence
    kept = track_kept[state.component_track] & (state.component_weight > parameters.prune_type)
    index = np.concatenate([np.arange(UE), block_indices(UE, np.flatnonzero(kept), 3).ravel()])
    renumbered = np.cumsum(track_kept) - 1
    track = renumbered[state.component_track[kept]]
    weight = state.component_weight[kept]
    weight = weight / np.bincount(track, weight, minlength=int(track_kept.sum()))[track]
    return replace(
        state,
        mean=state.mean[index],
        covariance=state.covariance[np.ix_(index, index)],
        origin=state.origin[kept],
        axes=state.axes[kept],
        component_track=track,
        component_type=state.component_type[kept],
        component_weight=weight,
        track_id=state.track_id[track_kept],
        existence=state.existence[track_kept],
    )


def _append_components(
    state: FilterState, q: FloatArray, covariances: FloatArray, gains: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Mean and covariance with new components behind the old ones."""
    old, new = len(state.mean), 3 * len(q)
    stacked = gains.reshape(-1, UE)
    joint = np.zeros((old + new, old + new))
    joint[:old, :old] = state.covariance
    joint[old:, :old] = stacked @ state.covariance[:UE]
    joint[:old, old:] = joint[old:, :old].T
    joint[old:, old:] = stacked @ state.ue_covariance @ stacked.T
    for number, covariance in enumerate(covariances):
        block = slice(old + 3 * number, old + 3 * number + 3)
        joint[block, block] = covariance
    return np.concatenate([state.mean, q.ravel()]), joint


def _measurement_rows(
    source: IntArray, assigned: BoolArray, evidence: Evidence, used: BoolArray, size: int
) -> FloatArray:
    """(H, 6 J, n) Jacobian of the stacked paths; zero rows where a path is not assigned."""
    hypotheses, paths = source.shape
    counts = assigned[:, :, None, None] & used[None, :, :, None]
    rows = np.zeros((hypotheses, paths, DIM, size))
    rows[..., :UE] = np.where(counts, evidence.ue_jacobian[source], 0.0)
    h, j = np.nonzero(source > 0)
    columns = block_indices(UE, source[h, j] - 1, 3)
    blocks = np.where(counts[h, j], evidence.landmark_jacobian[source[h, j]], 0.0)
    rows[h[:, None], j[:, None], :, columns] = np.swapaxes(blocks, 1, 2)
    return rows.reshape(hypotheses, paths * DIM, size)


def _uncoupled(state: FilterState) -> FilterState:
    """The marginal form of the paper: no covariance between vehicle, landmarks and types."""
    block = np.concatenate([np.zeros(UE), 1 + np.repeat(np.arange(len(state.origin)), 3)])
    same = block[:, None] == block[None, :]
    return replace(state, covariance=np.where(same, state.covariance, 0.0))
