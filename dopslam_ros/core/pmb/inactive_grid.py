"""The inactive landmarks by position: a grid of cells, each a struct of arrays."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property

import numpy as np

from dopslam_ros.core.linalg.arrays import FloatArray, IntArray
from dopslam_ros.core.pmb.density import Regressions
from dopslam_ros.core.pmb.inactive_kernels import to_reactivate
from dopslam_ros.core.settings.layout import LANDMARK_SIZES, VA

CellIndex = tuple[int, int]


@dataclass(frozen=True)
class InactiveLandmarks:
    """N scattering points and their regressions on A anchors, unused ones with id 0 and gain 0.

    Attributes:
        track_id: (N,).
        existence: (N,).
        reactivation_distance: (N,) distance of the vehicle at which they must be active [m].
        position: (N, 3) when they became inactive [m].
        origin: (N, 3) of their frames [m].
        axes: (N, 3, 3).
        q: (N, 3) local coordinates when they became inactive.
        covariance: (N, 3, 3) of q then.
        anchors: (N, A) track ids of the virtual anchors, the unused ones last.
        anchor_q: (N, 3 A) local coordinates of the anchors then.
        gain: (N, 3, 3 A) dq / d anchor_q.
        residual: (N, 3, 3) covariance of q given the anchors.
    """

    track_id: IntArray
    existence: FloatArray
    reactivation_distance: FloatArray
    position: FloatArray
    origin: FloatArray
    axes: FloatArray
    q: FloatArray
    covariance: FloatArray
    anchors: IntArray
    anchor_q: FloatArray
    gain: FloatArray
    residual: FloatArray

    def __len__(self) -> int:
        return len(self.track_id)

    @property
    def regressions(self) -> Regressions:
        """What ties them to their anchors."""
        return Regressions(
            self.anchors, self.anchor_q, self.gain, self.q, self.covariance, self.residual
        )

    def rows(self, which: IntArray) -> InactiveLandmarks:
        """Some of them."""
        return InactiveLandmarks(*(getattr(self, part.name)[which] for part in fields(self)))

    def with_room_for(self, anchors: int) -> InactiveLandmarks:
        """The same with room for so many anchors."""
        more = anchors - self.anchors.shape[1]
        if more <= 0:
            return self
        numbers = more * LANDMARK_SIZES[VA]
        return InactiveLandmarks(
            **{
                **{part.name: getattr(self, part.name) for part in fields(self)},
                "anchors": np.pad(self.anchors, [(0, 0), (0, more)]),
                "anchor_q": np.pad(self.anchor_q, [(0, 0), (0, numbers)]),
                "gain": np.pad(self.gain, [(0, 0), (0, 0), (0, numbers)]),
            }
        )


def together(parts: Sequence[InactiveLandmarks]) -> InactiveLandmarks:
    """All of them, one after the other."""
    most = max(part.anchors.shape[1] for part in parts)
    alike = [part.with_room_for(most) for part in parts]
    return InactiveLandmarks(
        *(
            np.concatenate([getattr(p, part.name) for p in alike])
            for part in fields(InactiveLandmarks)
        )
    )


@dataclass(frozen=True)
class InactiveGrid:
    """Inactive landmarks by the cell of the ground they are in.

    Attributes:
        cells: the landmarks of each cell that has some.
        largest_distance: the largest reactivation distance of any that ever were here [m].
    """

    cells: Mapping[CellIndex, InactiveLandmarks] = field(default_factory=dict)
    largest_distance: float = 0.0

    def __len__(self) -> int:
        return sum(map(len, self.cells.values()))

    @cached_property
    def landmarks(self) -> InactiveLandmarks | None:
        """All inactive landmarks, or None."""
        return together(list(self.cells.values())) if self.cells else None

    def with_more(self, landmarks: InactiveLandmarks, size: float) -> InactiveGrid:
        """With some more of them.

        Args:
            landmarks: to add.
            size: of a cell [m]; always the same.
        """
        cells = dict(self.cells)
        cell_of = np.floor(landmarks.position[:, :2] / size).astype(np.int64)
        for index in {(int(x), int(y)) for x, y in cell_of}:
            inside = landmarks.rows(np.flatnonzero((cell_of == index).all(axis=1)))
            cells[index] = together([cells[index], inside]) if index in cells else inside
        farthest = float(landmarks.reactivation_distance.max())
        return InactiveGrid(cells, max(self.largest_distance, farthest))

    def take(
        self, ue: FloatArray, margin: float, size: float
    ) -> tuple[InactiveLandmarks | None, InactiveGrid]:
        """Those that must be active, or None, and the rest.

        Args:
            ue: (2,) the vehicle [m].
            margin: added to every reactivation distance [m].
            size: of a cell [m].
        """
        cells: dict[CellIndex, InactiveLandmarks] | None = None
        found = []
        for index in self._indices(ue, self.largest_distance + margin, size):
            inside = self.cells.get(index)
            if inside is None:
                continue
            near = to_reactivate(inside.position, inside.reactivation_distance, ue, margin)
            if not near.any():
                continue
            cells = dict(self.cells) if cells is None else cells
            found.append(inside.rows(np.flatnonzero(near)))
            if near.all():
                del cells[index]
            else:
                cells[index] = inside.rows(np.flatnonzero(~near))
        if cells is None:
            return None, self
        return together(found), InactiveGrid(cells, self.largest_distance)

    def _indices(self, ue: FloatArray, distance: float, size: float) -> list[CellIndex]:
        """Cells of the square of a half width, or all there are where these are fewer."""
        rows, columns = (
            range(math.floor((at - distance) / size), math.floor((at + distance) / size) + 1)
            for at in ue.tolist()
        )
        if len(rows) * len(columns) > len(self.cells):
            return list(self.cells)
        return list(itertools.product(rows, columns))
