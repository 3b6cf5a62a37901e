"""What the filter knows and how it is set."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from dopslam_ros.core.linalg.arrays import (
    BoolArray,
    FloatArray,
    IntArray,
    floats,
    integers,
)
from dopslam_ros.core.pmb.coordinates_kernels import components_in_space
from dopslam_ros.core.pmb.density import Density, Undetected, block_starts
from dopslam_ros.core.pmb.inactive_grid import InactiveGrid
from dopslam_ros.core.pmb.undetected import nothing_seen
from dopslam_ros.core.settings.filtering import FilterParameters
from dopslam_ros.core.settings.layout import ANGLES


@dataclass(frozen=True)
class FilterState:
    """What the filter knows of vehicle and map.

    Attributes:
        density: of the vehicle and of all landmarks that may be detected from where it is.
        inactive: landmarks put aside while they are out of view.
    """

    density: Density
    inactive: InactiveGrid

    # The parts of the density, which says what they are.

    @property
    def mean(self) -> FloatArray:
        """(n,)."""
        return self.density.mean

    @property
    def covariance(self) -> FloatArray:
        """(n, n)."""
        return self.density.covariance

    @property
    def start(self) -> IntArray:
        """(C + 1,)."""
        return self.density.start

    @property
    def origin(self) -> FloatArray:
        """(C, 3) [m]."""
        return self.density.origin

    @property
    def axes(self) -> FloatArray:
        """(C, 3, 3)."""
        return self.density.axes

    @property
    def component_track(self) -> IntArray:
        """(C,)."""
        return self.density.component_track

    @property
    def component_type(self) -> IntArray:
        """(C,)."""
        return self.density.component_type

    @property
    def component_weight(self) -> FloatArray:
        """(C,)."""
        return self.density.component_weight

    @property
    def track_id(self) -> IntArray:
        """(T,)."""
        return self.density.track_id

    @property
    def existence(self) -> FloatArray:
        """(T,)."""
        return self.density.existence

    @property
    def undetected(self) -> Undetected:
        """Where landmarks never detected may still be."""
        return self.density.undetected

    @property
    def next_id(self) -> int:
        """The id of the next new track."""
        return self.density.next_id

    def but(self, **parts: Any) -> FilterState:
        """The same with other parts of the density."""
        ready = {name: _as_compiled(value) for name, value in parts.items()}
        if "component_type" in ready:
            ready["start"] = block_starts(len(self.ue_mean), ready["component_type"])
        return FilterState(self.density._replace(**ready), self.inactive)

    @property
    def ue_mean(self) -> FloatArray:
        """(U,) estimate of the vehicle."""
        return self.mean[: self.start[0]]

    @property
    def ue_covariance(self) -> FloatArray:
        """(U, U) its covariance."""
        return self.covariance[: self.start[0], : self.start[0]]

    @property
    def all_track_ids(self) -> IntArray:
        """Ids of all tracks, active or inactive."""
        return np.concatenate([self.track_id, *(c.track_id for c in self.inactive.cells.values())])

    def columns(self, components: IntArray) -> IntArray:
        """Where the numbers of some components are in the joint vector, one block after another."""
        start = self.density.start
        return np.concatenate([[], *(np.arange(*start[c : c + 2]) for c in components)]).astype(int)

    @property
    def positions(self) -> FloatArray:
        """(C, 3) where the components are [m]."""
        return components_in_space(self.density)[0]

    def only(self, components: BoolArray, tracks: BoolArray) -> FilterState:
        """What is left of it.

        Args:
            components: (C,) which are kept.
            tracks: (T,) which are kept; they have a component that is.
        """
        kept = np.flatnonzero(components)
        index = np.concatenate([np.arange(self.start[0]), self.columns(kept)])
        renumbered = np.cumsum(tracks) - 1
        return self.but(
            mean=self.mean[index],
            covariance=self.covariance[np.ix_(index, index)],
            origin=self.origin[components],
            axes=self.axes[components],
            component_track=renumbered[self.component_track[components]],
            component_type=self.component_type[components],
            component_weight=self.component_weight[components],
            track_id=self.track_id[tracks],
            existence=self.existence[tracks],
        )


def _as_compiled(value: Any) -> Any:
    """A part of a density as the compiled functions take it."""
    if not isinstance(value, np.ndarray):
        return value
    return floats(value) if value.dtype.kind == "f" else integers(value)


def initial_filter_state(parameters: FilterParameters) -> FilterState:
    """The density before the first snapshot: the prior of the vehicle and an unknown map."""
    none = np.zeros(0, dtype=np.int64)
    # Components beyond those that the models know are no angles.
    vehicle = ANGLES + (False,) * (len(parameters.initial_state) - len(ANGLES))
    density = Density(
        mean=np.array(parameters.initial_state),
        covariance=floats(parameters.initial_covariance),
        vehicle=vehicle,
        start=np.array([len(vehicle)]),
        origin=np.zeros((0, 3)),
        axes=np.zeros((0, 3, 3)),
        component_track=none,
        component_type=none,
        component_weight=np.zeros(0),
        track_id=none,
        existence=np.zeros(0),
        undetected=nothing_seen(),
        next_id=1,
    )
    return FilterState(density, InactiveGrid())
