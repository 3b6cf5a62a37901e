"""The motion of vehicle and map, for the filters that are written in NumPy."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from dopslam_ros.core.linalg.arrays import FloatArray, floats
from dopslam_ros.core.models import motion
from dopslam_ros.core.models.motion import ControlSpan, span_rows
from dopslam_ros.core.settings.filtering import FilterParameters


class Gaussian(NamedTuple):
    """Mean (n,) and covariance (n, n), the vehicle first."""

    mean: FloatArray
    covariance: FloatArray


def predict(
    mean: FloatArray,
    covariance: FloatArray,
    spans: Sequence[ControlSpan],
    parameters: FilterParameters,
) -> Gaussian:
    """The vehicle moves by f with F P F' + Q; the map is static, its correlation follows F.

    Args:
        mean: (n,) before.
        covariance: (n, n) before.
        spans: the controls since then.
        parameters: with the process noise.
    """
    rows, rate = span_rows(spans), parameters.noise_rate
    return Gaussian(*motion.predict(floats(mean), floats(covariance), rows, rate))
