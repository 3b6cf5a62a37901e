"""The map as it is shown."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from dopslam_ros.core.linalg.arrays import FloatArray, IntArray
from dopslam_ros.core.pmb.coordinates_kernels import components_in_space
from dopslam_ros.core.pmb.density import Density
from dopslam_ros.core.pmb.inactive import current_in_space
from dopslam_ros.core.pmb.inactive_grid import InactiveGrid
from dopslam_ros.core.pmb.posterior import Posterior
from dopslam_ros.core.settings.filtering import FilterParameters
from dopslam_ros.core.settings.layout import LandmarkType


@dataclass(frozen=True)
class LandmarkEstimates:
    """The landmarks that are reported, the BS not among them.

    Attributes:
        ids: (L,) stable ids.
        types: (L,) most probable type.
        type_probabilities: (L, 3) in the order of LandmarkType.
        existence: (L,) probabilities.
        positions: (L, 3) [m], given the type.
        covariances: (L, 3, 3) [m^2].
    """

    ids: IntArray
    types: IntArray
    type_probabilities: FloatArray
    existence: FloatArray
    positions: FloatArray
    covariances: FloatArray


_PARTS = tuple(part.name for part in fields(LandmarkEstimates))


def reported_landmarks(state: Posterior, parameters: FilterParameters) -> LandmarkEstimates:
    """The map of the likeliest hypothesis: landmarks that surely exist, of known position."""
    density = state.density
    tracks = len(density.track_id)
    probabilities = np.zeros((tracks, len(LandmarkType)))
    probabilities[density.component_track, density.component_type] = density.component_weight
    best = np.zeros(tracks, dtype=np.int64)
    # Ascending weight: the heaviest component of a track is written last.
    order = np.argsort(density.component_weight, kind="stable")
    best[density.component_track[order]] = order
    position, covariance = components_in_space(density)
    active = LandmarkEstimates(
        ids=density.track_id,
        types=density.component_type[best],
        type_probabilities=probabilities,
        existence=density.existence,
        positions=position[best],
        covariances=covariance[best],
    )
    everything = _together(active, _out_of_view(density, state.inactive[0]))
    std = np.sqrt(np.trace(everything.covariances, axis1=1, axis2=2))
    shown = (everything.existence >= parameters.report_existence) & (std <= parameters.report_std)
    order = np.flatnonzero(shown)
    return _rows(everything, order[np.argsort(everything.ids[order], kind="stable")])


def _out_of_view(density: Density, grid: InactiveGrid) -> LandmarkEstimates | None:
    inactive = grid.landmarks
    if inactive is None:
        return None
    position, covariance = current_in_space(density, inactive)
    types = np.full(len(inactive), int(LandmarkType.SP))
    return LandmarkEstimates(
        ids=inactive.track_id,
        types=types,
        type_probabilities=np.eye(len(LandmarkType))[types],
        existence=inactive.existence,
        positions=position,
        covariances=covariance,
    )


def _rows(landmarks: LandmarkEstimates, which: IntArray) -> LandmarkEstimates:
    return LandmarkEstimates(*[getattr(landmarks, name)[which] for name in _PARTS])


def _together(one: LandmarkEstimates, other: LandmarkEstimates | None) -> LandmarkEstimates:
    if other is None:
        return one
    pairs = [(getattr(one, name), getattr(other, name)) for name in _PARTS]
    return LandmarkEstimates(*map(np.concatenate, pairs))
