"""Which landmark of a filter stands for which true one, and how much weight the truth gets."""

from __future__ import annotations

import numpy as np

from dopslam_ros.core.linalg.arrays import IntArray
from dopslam_ros.core.pmb import Associations
from dopslam_ros.core.settings.layout import BS_ID, NONE
from dopslam_ros.simulation.simulator import Snapshot


class SourceTracker:
    """Remembers which track stands for which true landmark: the one that got most of its paths.

    What counts is the weight with which each path was given to a track, or gave birth to it.
    """

    def __init__(self) -> None:
        self._fed: dict[tuple[int, int], float] = {}

    def correct_weight(
        self, snapshot: Snapshot, associations: Associations, known: IntArray
    ) -> float:
        """Weight, among the hypotheses kept, of the association that is true.

        Args:
            snapshot: with the true sources.
            associations: of the filter at this snapshot.
            known: ids of the tracks before the snapshot.
        """
        owners = self._owners(set(known.tolist()))
        true = [owners.get(source, NONE) for source in snapshot.sources.tolist()]
        right = (associations.ids == np.array(true, dtype=np.int64)).all(axis=1)
        for path, source in enumerate(snapshot.sources.tolist()):
            if source > 0:
                born = int(associations.born[path])
                for track, weight in zip(
                    associations.ids[:, path].tolist(), associations.weight.tolist(), strict=True
                ):
                    key = (source, born if track == NONE else track)
                    self._fed[key] = self._fed.get(key, 0.0) + weight
        return float(associations.weight[right].sum())

    def _owners(self, alive: set[int]) -> dict[int, int]:
        """The track of each source, 0 being the BS; of a track that was fed by two, the first."""
        self._fed = {key: fed for key, fed in self._fed.items() if key[1] in alive}
        owners = {0: BS_ID}
        taken = set()
        for source, track in sorted(self._fed, key=lambda key: (-self._fed[key], key)):
            if source not in owners and track not in taken:
                owners[source] = track
                taken.add(track)
        return owners
