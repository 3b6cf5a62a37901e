"""Quantiles, of the few distributions that are needed; ``scipy.stats`` takes a second to import."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.special import gammaincinv, stdtrit

from dopslam_ros.core.linalg.arrays import FloatArray


def chi_square(probability: Any, freedom: Any) -> FloatArray:
    """What a chi-square stays below with a probability; NaN for no degree of freedom.

    Args:
        probability: number or array in 0 ... 1.
        freedom: degrees of freedom, number or array.
    """
    return np.asarray(2.0 * gammaincinv(np.asarray(freedom) / 2.0, probability))


def student_t(probability: float, freedom: float) -> float:
    """What Student's t stays below with a probability."""
    return float(stdtrit(freedom, probability))
