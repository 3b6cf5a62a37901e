"""The density of EK-PHD SLAM: a Gaussian vehicle and the intensity of the map."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from dopslam_ros.core.linalg.arrays import FloatArray, IntArray
from dopslam_ros.core.pmb.density import Undetected
from dopslam_ros.core.pmb.undetected import nothing_seen
from dopslam_ros.core.settings.filtering import FilterParameters
from dopslam_ros.core.settings.layout import SPACE


@dataclass(frozen=True)
class PhdState:
    """A Gaussian vehicle and, independent of it, the intensity (PHD) of the map.

    Attributes:
        ue_mean: (U,) x [m], y [m], heading [rad], clock bias [m] (``layout.VEHICLE``).
        ue_covariance: (U, U).
        weights: (C,) expected number of landmarks that each component stands for.
        means: (C, 3) [m].
        covariances: (C, 3, 3) [m^2].
        types: (C,) VA or SP.
        undetected: where the intensity is still that of landmarks never detected.
    """

    ue_mean: FloatArray
    ue_covariance: FloatArray
    weights: FloatArray
    means: FloatArray
    covariances: FloatArray
    types: IntArray
    undetected: Undetected


def initial_phd(parameters: FilterParameters) -> PhdState:
    """The density before the first snapshot: the prior of the vehicle and an unknown map."""
    return PhdState(
        ue_mean=np.array(parameters.initial_state),
        ue_covariance=parameters.initial_covariance,
        weights=np.zeros(0),
        means=np.zeros((0, SPACE)),
        covariances=np.zeros((0, SPACE, SPACE)),
        types=np.zeros(0, dtype=np.int64),
        undetected=nothing_seen(),
    )


class Components(NamedTuple):
    """A Gaussian mixture, fields as in PhdState."""

    weights: FloatArray
    means: FloatArray
    covariances: FloatArray
    types: IntArray

    def at(self, index: IntArray) -> Components:
        """Those at ``index``."""
        return Components(
            self.weights[index], self.means[index], self.covariances[index], self.types[index]
        )
