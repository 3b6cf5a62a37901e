"""The PMB density of vehicle and map, as the compiled functions take it."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from dopslam_ros.core.linalg.arrays import BoolArray, FloatArray, IntArray, floats, integers
from dopslam_ros.core.linalg.jit import from_python, jit
from dopslam_ros.core.settings.layout import ALIKE, LANDMARK_SIZES, LARGEST_LANDMARK, Components


class Undetected(NamedTuple):
    """From where how often nothing new was detected.

    Attributes:
        looks: number of snapshots so far.
        viewpoints: (K, 2) places of the vehicle [m], those whose field of view still matters.
        viewpoint_looks: (K,) number of snapshots near each.
    """

    looks: int
    viewpoints: FloatArray
    viewpoint_looks: IntArray


class Regressions(NamedTuple):
    """What ties N landmarks out of view to A virtual anchors; see ``InactiveLandmarks``.

    Attributes:
        anchors: (N, A) track ids of the anchors, 0 where there are fewer.
        anchor_q: (N, 3 A) local coordinates of the anchors then.
        gain: (N, 3, 3 A) dq / d anchor_q.
        q: (N, 3) local coordinates then.
        covariance: (N, 3, 3) of q then.
        residual: (N, 3, 3) covariance of q given the anchors.
    """

    anchors: IntArray
    anchor_q: FloatArray
    gain: FloatArray
    q: FloatArray
    covariance: FloatArray
    residual: FloatArray


class Density(NamedTuple):
    """A PMB density, eqs. (26)-(29): a Gaussian over vehicle and components, the rest per landmark.

    A landmark (track) has a component for each type it may still be. The joint vector is
    [s; q_1 ... q_C], q the range and direction of a component in its own frame (see
    ``coordinates``); with ``coupling: marginal`` the covariance is block diagonal between steps.

    Attributes:
        mean: (n,) the vehicle's components (``layout.VEHICLE``), then q of the landmarks'.
        covariance: (n, n).
        vehicle: which of the vehicle's components are angles; its length is their number.
        start: (C + 1,) where the block of each component begins in the joint vector; the vehicle's
            is before the first one, the last entry is n.
        origin: (C, 3) where the frames of the components are [m].
        axes: (C, 3, 3) their axes, in columns.
        component_track: (C,) index of the track each component belongs to, ascending.
        component_type: (C,) VA or SP.
        component_weight: (C,) probability of the type, given that the track exists.
        track_id: (T,) stable ids, from 1 on (0 is the BS).
        existence: (T,) probability that the landmark exists, r.
        undetected: where landmarks never detected may still be.
        next_id: the id of the next new track.
    """

    mean: FloatArray
    covariance: FloatArray
    vehicle: Components
    start: IntArray
    origin: FloatArray
    axes: FloatArray
    component_track: IntArray
    component_type: IntArray
    component_weight: FloatArray
    track_id: IntArray
    existence: FloatArray
    undetected: Undetected
    next_id: int

    @property
    def ue_mean(self) -> FloatArray:
        """(U,) estimate of the vehicle."""
        return self.mean[: self.start[0]]

    @property
    def ue_covariance(self) -> FloatArray:
        """(U, U) its covariance."""
        return self.covariance[: self.start[0], : self.start[0]]

    def but(self, **parts: Any) -> Density:
        """The same with other parts."""
        ready = {name: _as_compiled(value) for name, value in parts.items()}
        if "component_type" in ready:
            ready["start"] = block_starts(len(self.vehicle), ready["component_type"])
        return self._replace(**ready)

    def only(self, components: BoolArray, tracks: BoolArray) -> Density:
        """What is left of it.

        Args:
            components: (C,) which are kept.
            tracks: (T,) which are kept; they have a component that is.
        """
        kept = np.repeat(components, np.diff(self.start))
        index = np.concatenate([np.arange(self.start[0]), self.start[0] + np.flatnonzero(kept)])
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


@from_python
def block_starts(vehicle: int, types: IntArray) -> IntArray:
    """(C + 1,) where the block of each component begins; the last entry is the size of the vector.

    Args:
        vehicle: how many numbers the vehicle has; its block is the first one.
        types: (C,) LandmarkType of the components, which says how many numbers each has.
    """
    start = np.empty(len(types) + 1, np.int64)
    start[0] = vehicle
    for c in range(len(types)):
        start[c + 1] = start[c] + LANDMARK_SIZES[types[c]]
    return start


@jit
def block_of(start: IntArray, source: int) -> tuple[int, int]:
    """First index and size of the block of source m, component m - 1; none of the BS's, 0."""
    first = start[source - 1]
    return first, LARGEST_LANDMARK if ALIKE else start[source] - first


@jit
def block_bounds(start: IntArray, block: int) -> tuple[int, int]:
    """Where a block begins and ends in the joint vector: 0 the vehicle's, then the components'."""
    begin: int = start[block - 1] if block > 0 else 0
    return begin, start[block]


@jit
def block_numbers(start: IntArray) -> IntArray:
    """(n,) the block of each number of the joint vector: 0 the vehicle's, then the components'."""
    numbers = np.zeros(start[-1], np.int64)
    for c in range(len(start) - 1):
        for i in range(start[c], start[c + 1]):
            numbers[i] = 1 + c
    return numbers
