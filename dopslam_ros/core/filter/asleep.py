"""Scattering points out of view are put aside, so that they cost nothing until they come back.

A landmark that cannot be detected learns only through what it has in common with the rest. Of that,
nearly all goes through the virtual anchors, which stay in view: given them, an SP that was left
behind and the vehicle of later hardly depend on each other. So a landmark that falls asleep keeps
its regression on the anchors,

    q = q_then + gain (anchor_q - anchor_q_then) + noise of covariance ``residual``,

which no later update of vehicle and anchors changes. When it wakes up, its mean, its covariance and
its correlation with everything follow from the anchors as they are then. What is lost is what two
landmarks, or a landmark and the vehicle, have in common beyond the anchors.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from dopslam_ros.core.arrays import BoolArray, FloatArray, IntArray, block_indices, symmetrise
from dopslam_ros.core.channel import LandmarkType
from dopslam_ros.core.filter.sleepers import Sleepers
from dopslam_ros.core.filter.state import UE, FilterParameters, FilterState
from dopslam_ros.core.kernels.asleep import MARGIN, left_behind

# Only virtual anchors that surely are what they are carry others.
SURE = 0.999
# Less likely than this when it is left behind, a landmark is forgotten.
FORGOTTEN = 0.05
# Smallest cell of the grid [m].
SMALLEST_CELL = 1.0


def fall_asleep(state: FilterState, parameters: FilterParameters) -> FilterState:
    """Puts SPs aside that the vehicle has left behind."""
    reach, leaving = left_behind(state.density, float(parameters.sp_field_of_view))
    if not leaving.any():
        return state
    asleep = state.asleep
    least = FORGOTTEN if parameters.mapping else 0.0
    remembered = np.flatnonzero((leaving & (state.existence >= least))[state.component_track])
    if len(remembered):
        sleepers = _sleepers(state, remembered, reach[remembered])
        asleep = asleep.with_more(sleepers, _cell_size(parameters))
    awake = state.only(~leaving[state.component_track], ~leaving)
    return replace(awake, asleep=asleep)


def wake_up(state: FilterState, parameters: FilterParameters) -> FilterState:
    """Takes those back that may be detected from where the vehicle is."""
    if not state.asleep.cells:
        return state
    found, asleep = state.asleep.take(state.ue_mean[:2], _blur(state), _cell_size(parameters))
    if found is None:
        return state
    gain, q, residual = _regression(state, found)
    count, n, tracks = len(found), len(state.mean), len(state.track_id)
    joint = np.zeros((n + 3 * count, n + 3 * count))
    joint[:n, :n] = state.covariance
    joint[n:, :n] = gain.reshape(3 * count, n) @ state.covariance
    joint[:n, n:] = joint[n:, :n].T
    joint[n:, n:] = joint[n:, :n] @ gain.reshape(3 * count, n).T
    for number in range(count):
        block = slice(n + 3 * number, n + 3 * number + 3)
        joint[block, block] += residual[number]
    return replace(
        state,
        mean=np.concatenate([state.mean, q.ravel()]),
        covariance=symmetrise(joint),
        origin=np.concatenate([state.origin, found.origin]),
        axes=np.concatenate([state.axes, found.axes]),
        component_track=np.concatenate([state.component_track, tracks + np.arange(count)]),
        component_type=np.append(state.component_type, np.full(count, int(LandmarkType.SP))),
        component_weight=np.append(state.component_weight, np.ones(count)),
        track_id=np.append(state.track_id, found.track_id),
        existence=np.append(state.existence, found.existence),
        asleep=asleep,
    )


def as_of_now(state: FilterState, sleepers: Sleepers) -> tuple[FloatArray, FloatArray]:
    """(N, 3) placements and (N, 3, 3) covariances of sleepers, as the anchors have it now."""
    gain, q, residual = _regression(state, sleepers)
    return q, residual + symmetrise(gain @ state.covariance @ np.swapaxes(gain, 1, 2))


def _blur(state: FilterState) -> float:
    """How far the vehicle may be from where it seems to be [m]."""
    return MARGIN * math.sqrt(state.covariance[0, 0] + state.covariance[1, 1])


def _cell_size(parameters: FilterParameters) -> float:
    return max(parameters.sp_field_of_view, SMALLEST_CELL)


def _anchors(state: FilterState) -> IntArray:
    """Components of virtual anchors that are sure: no other stays in view for good."""
    sure = state.existence[state.component_track] * state.component_weight > SURE
    return np.flatnonzero(sure & (state.component_type == LandmarkType.VA))


def _sleepers(state: FilterState, components: IntArray, reach: FloatArray) -> Sleepers:
    """Components, the only ones of their tracks, as they are put aside."""
    anchors = _anchors(state)
    count = len(components)
    index = block_indices(UE, anchors, 3).ravel()
    own = block_indices(UE, components, 3).ravel()
    cross = state.covariance[own][:, index]
    within = state.covariance[np.ix_(index, index)]
    # In memory as a file gives it back: products round otherwise in another order.
    gain = np.ascontiguousarray(np.linalg.solve(within, cross.T).T, np.float64)
    covariance = state.placement_covariances[components]
    explained = gain.reshape(count, 3, -1) @ np.swapaxes(cross.reshape(count, 3, -1), 1, 2)
    track = state.component_track[components]
    return Sleepers(
        track_id=state.track_id[track],
        existence=state.existence[track],
        reach=reach,
        position=state.positions[components],
        origin=state.origin[components],
        axes=state.axes[components],
        q=state.placements[components],
        covariance=covariance,
        anchors=np.tile(state.track_id[state.component_track[anchors]], (count, 1)),
        anchor_q=np.tile(state.mean[index], (count, 1)),
        gain=gain.reshape(count, 3, -1),
        residual=symmetrise(covariance - explained),
    )


def _located(state: FilterState, sleepers: Sleepers) -> tuple[IntArray, BoolArray]:
    """(N, A) components that the anchors are now, and (N,) whether all are still there.

    Unused places get component -1.
    """
    vas = np.flatnonzero(state.component_type == LandmarkType.VA)
    ids = state.track_id[state.component_track[vas]]
    order = np.argsort(ids)
    at = np.searchsorted(ids[order], sleepers.anchors)
    at = np.minimum(at, max(len(ids) - 1, 0))
    used = sleepers.anchors > 0
    if not len(ids):
        return np.full(used.shape, -1), np.asarray(~used.any(axis=1))
    hit = ids[order][at] == sleepers.anchors
    component = np.where(used & hit, vas[order][at], -1)
    return component, np.asarray((hit | ~used).all(axis=1))


def _regression(
    state: FilterState, sleepers: Sleepers
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """How q depends on the joint vector as it is now; not at all for those that lost an anchor.

    Returns:
        (N, 3, n) gains, (N, 3) q, and (N, 3, 3) its covariance given the joint vector.
    """
    component, complete = _located(state, sleepers)
    count, places = component.shape
    n = len(state.mean)
    # Columns beyond the last are for places that are not used.
    gain = np.zeros((count, 3, n + 3))
    columns = UE + 3 * component[:, :, None] + np.arange(3)
    columns = np.where(component[:, :, None] >= 0, columns, n)
    parts = sleepers.gain.reshape(count, 3, places, 3)
    row = np.arange(count)
    for place in range(places):
        for c in range(3):
            gain[row, :, columns[:, place, c]] += parts[:, :, place, c]

    placements = np.vstack([state.placements, np.zeros((1, 3))])[component]
    moved = placements.reshape(count, -1) - sleepers.anchor_q
    shift = (sleepers.gain @ moved[:, :, None])[:, :, 0]
    q = sleepers.q + np.where(complete[:, None], shift, 0.0)
    residual = np.where(complete[:, None, None], sleepers.residual, sleepers.covariance)
    return gain[:, :, :n] * complete[:, None, None], q, residual
