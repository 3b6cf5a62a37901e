"""Whether numbers are the moments of a Gaussian."""

from __future__ import annotations

import math

from dopslam_ros.core.linalg.arrays import FloatArray
from dopslam_ros.core.linalg.jit import from_python
from dopslam_ros.core.linalg.small import cholesky

# What rounding may do to a covariance: relative to its variances, and at all.
ASYMMETRY, INDEFINITENESS, TINY = 1e-9, 1e-9, 1e-12
# Covariances up to this size are factored to see whether they are one.
MOST_FACTORED = 64


@from_python
def is_gaussian(mean: FloatArray, covariance: FloatArray, first: int) -> bool:
    """Whether all is finite, symmetric and positive definite, as far as rounding lets one tell.

    Of a large covariance, whose factor would cost as much as a step, all variances are looked at
    and the first part is factored.

    Args:
        mean: (n,), what matters most first.
        covariance: (n, n).
        first: how many numbers matter most.
    """
    n, most = len(mean), 0.0
    for i in range(n):
        if not (math.isfinite(mean[i]) and covariance[i, i] >= 0.0):
            return False
        most = max(most, covariance[i, i])
    within = ASYMMETRY * most + TINY
    if not math.isfinite(within):
        return False
    for i in range(n):
        for j in range(i):
            # Not a number is not within anything.
            if not (
                math.isfinite(covariance[i, j])
                and abs(covariance[i, j] - covariance[j, i]) <= within
            ):
                return False
    size = n if n <= MOST_FACTORED else first
    factor = covariance[:size, :size].copy()
    for i in range(size):
        factor[i, i] += INDEFINITENESS * factor[i, i] + TINY
    return cholesky(factor, size)
