"""Maps for the tests of messages."""

from __future__ import annotations

import numpy as np

from dopslam_ros.core.pmb import LandmarkEstimates
from dopslam_ros.core.settings.layout import LandmarkType

BS = np.array([0.0, 0.0, 40.0])
VA, SP = int(LandmarkType.VA), int(LandmarkType.SP)


def landmarks(*rows: tuple[int, int], seed: int = 0) -> LandmarkEstimates:
    """Landmarks (id, type) with places and covariances of their own."""
    rng = np.random.default_rng(seed)
    ids = np.array([row[0] for row in rows], dtype=np.int64)
    kinds = np.array([row[1] for row in rows], dtype=np.int64)
    roots = rng.normal(size=(len(rows), 3, 3))
    return LandmarkEstimates(
        ids=ids,
        types=kinds,
        type_probabilities=np.eye(3)[kinds],
        existence=np.full(len(rows), 0.75),
        positions=rng.normal(size=(len(rows), 3)) * 100.0,
        covariances=roots @ roots.swapaxes(1, 2),
    )
