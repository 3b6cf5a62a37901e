"""Scattering points out of view become inactive, so that they cost nothing until they come back.

A landmark that cannot be detected learns only through what it has in common with the rest. Of that,
nearly all goes through the virtual anchors, which stay in view: given them, an SP that was left
behind and the vehicle of later hardly depend on each other. So a landmark that becomes inactive
keeps its regression on the anchors,

    q = q_then + gain (anchor_q - anchor_q_then) + noise of covariance ``residual``,

which no later update of vehicle and anchors changes. When it is reactivated, its mean, covariance
and correlation with everything follow from the anchors as they are then. What is lost is what two
landmarks, or a landmark and the vehicle, have in common beyond the anchors.
"""

from __future__ import annotations

import math

import numpy as np

from dopslam_ros.core.linalg.arrays import FloatArray, IntArray, symmetrise
from dopslam_ros.core.pmb import inactive_kernels as kernels
from dopslam_ros.core.pmb.coordinates_kernels import components_in_space, in_space
from dopslam_ros.core.pmb.density import Density
from dopslam_ros.core.pmb.inactive_grid import InactiveGrid, InactiveLandmarks
from dopslam_ros.core.pmb.inactive_kernels import MARGIN, left_behind
from dopslam_ros.core.settings.filtering import FilterParameters
from dopslam_ros.core.settings.layout import LANDMARK_SIZES, LandmarkType, X, Y

# Only virtual anchors that surely are what they are carry others.
SURE = 0.999
# Less likely than this when it is left behind, a landmark is forgotten.
FORGOTTEN = 0.05
# Smallest cell of the grid [m].
SMALLEST_CELL = 1.0


def deactivate(
    density: Density, inactive: InactiveGrid, parameters: FilterParameters
) -> tuple[Density, InactiveGrid]:
    """Takes SPs that the vehicle has left behind out of the density."""
    distance, leaving = left_behind(density, float(parameters.sp_field_of_view))
    if not leaving.any():
        return density, inactive
    least = FORGOTTEN if parameters.mapping else 0.0
    remembered = np.flatnonzero((leaving & (density.existence >= least))[density.component_track])
    if len(remembered):
        landmarks = _inactive_landmarks(density, remembered, distance[remembered])
        inactive = inactive.with_more(landmarks, _cell_size(parameters))
    return density.only(~leaving[density.component_track], ~leaving), inactive


def reactivate(
    density: Density, inactive: InactiveGrid, parameters: FilterParameters
) -> tuple[Density, InactiveGrid]:
    """Appends those to the density that may be detected from where the vehicle is."""
    if not inactive.cells:
        return density, inactive
    found, inactive = inactive.take(
        density.ue_mean[[X, Y]], _position_margin(density), _cell_size(parameters)
    )
    if found is None:
        return density, inactive
    count, tracks = len(found), len(density.track_id)
    mean, covariance = kernels.reactivated(density, found.regressions)
    active = density.but(
        mean=mean,
        covariance=covariance,
        origin=np.concatenate([density.origin, found.origin]),
        axes=np.concatenate([density.axes, found.axes]),
        component_track=np.concatenate([density.component_track, tracks + np.arange(count)]),
        component_type=np.append(density.component_type, np.full(count, int(LandmarkType.SP))),
        component_weight=np.append(density.component_weight, np.ones(count)),
        track_id=np.append(density.track_id, found.track_id),
        existence=np.append(density.existence, found.existence),
    )
    return active, inactive


def current(density: Density, landmarks: InactiveLandmarks) -> tuple[FloatArray, FloatArray]:
    """(N, 3) local coordinates and (N, 3, 3) covariances of inactive landmarks now."""
    return kernels.current(density, landmarks.regressions)


def current_in_space(
    density: Density, landmarks: InactiveLandmarks
) -> tuple[FloatArray, FloatArray]:
    """(N, 3) positions [m] and (N, 3, 3) covariances [m^2] of inactive landmarks now."""
    return in_space(landmarks.origin, landmarks.axes, *current(density, landmarks))


def _position_margin(density: Density) -> float:
    """How far the vehicle may be from where it seems to be [m]."""
    return MARGIN * math.sqrt(density.covariance[X, X] + density.covariance[Y, Y])


def _cell_size(parameters: FilterParameters) -> float:
    return max(parameters.sp_field_of_view, SMALLEST_CELL)


def _anchors(density: Density) -> IntArray:
    """Components of virtual anchors that are sure: no other stays in view for good."""
    sure = density.existence[density.component_track] * density.component_weight > SURE
    return np.flatnonzero(sure & (density.component_type == LandmarkType.VA))


def _numbers_of(density: Density, components: IntArray, kind: LandmarkType) -> IntArray:
    """(N, D) where the numbers of components of a type are in the joint vector."""
    return density.start[components][:, None] + np.arange(LANDMARK_SIZES[kind])


def _inactive_landmarks(
    density: Density, components: IntArray, reactivation_distance: FloatArray
) -> InactiveLandmarks:
    """Components, the only ones of their tracks, as they become inactive."""
    anchors, count = _anchors(density), len(components)
    index = _numbers_of(density, anchors, LandmarkType.VA).ravel()
    own = _numbers_of(density, components, LandmarkType.SP)
    cross = density.covariance[own.ravel()][:, index]
    within = density.covariance[np.ix_(index, index)]
    # In memory as a file gives it back: products round otherwise in another order.
    gain = np.ascontiguousarray(np.linalg.solve(within, cross.T).T, np.float64)
    gain = gain.reshape(*own.shape, len(index))
    covariance = density.covariance[own[:, :, None], own[:, None, :]]
    explained = gain @ np.swapaxes(cross.reshape(gain.shape), 1, 2)
    track = density.component_track[components]
    return InactiveLandmarks(
        track_id=density.track_id[track],
        existence=density.existence[track],
        reactivation_distance=reactivation_distance,
        position=components_in_space(density)[0][components],
        origin=density.origin[components],
        axes=density.axes[components],
        q=density.mean[own],
        covariance=covariance,
        anchors=np.tile(density.track_id[density.component_track[anchors]], (count, 1)),
        anchor_q=np.tile(density.mean[index], (count, 1)),
        gain=gain,
        residual=symmetrise(covariance - explained),
    )
