"""The step on a known map: only the vehicle is estimated, the map stays as it is.

The map is uncertain nevertheless, and the vehicle's error is correlated with the map's. So the
update is that of Schmidt's consider filter, with the gain K for the vehicle and none for the map:

    P_ss <- P_ss - K S K',   P_sm <- P_sm - K H P_m,   P_mm as it was.

K being the vehicle's rows of P H' S^-1, these are the vehicle's rows of the ordinary joint update.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dopslam_ros.core.arrays import FloatArray, symmetrise, wrap_angle
from dopslam_ros.core.filter.asleep import fall_asleep
from dopslam_ros.core.filter.state import UE, FilterParameters, FilterState
from dopslam_ros.core.kernels.update import uncouple


def localised(
    predicted: FilterState,
    means: FloatArray,
    covariances: FloatArray,
    weight: FloatArray,
    parameters: FilterParameters,
) -> FilterState:
    """The density after a snapshot, moments matched over the hypotheses; the map is untouched.

    Args:
        predicted: the density the paths were weighed against.
        means: (H, n) of the joint update under each hypothesis.
        covariances: (H, n, n).
        weight: (H,) of the hypotheses, normalised.
        parameters: coupling and the field of view.
    """
    ue = weight @ means[:, :UE]
    off = means[:, :UE] - ue
    rows = np.tensordot(weight, covariances[:, :UE], 1)
    rows[:, :UE] = symmetrise(rows[:, :UE] + (off.T * weight) @ off)
    ue[2] = wrap_angle(ue[2])
    covariance = predicted.covariance.copy()
    covariance[:UE], covariance[:, :UE] = rows, rows.T
    if parameters.coupling == "marginal":
        uncouple(covariance)
    mean = np.concatenate([ue, predicted.mean[UE:]])
    return fall_asleep(replace(predicted, mean=mean, covariance=covariance), parameters)
