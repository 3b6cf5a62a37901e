"""Which scattering points the vehicle has left behind, and how they are when it comes back."""

from __future__ import annotations

import math

import numpy as np

from dopslam_ros.core.linalg.arrays import BoolArray, FloatArray
from dopslam_ros.core.linalg.jit import from_python, jit
from dopslam_ros.core.pmb.coordinates_kernels import components_in_space
from dopslam_ros.core.pmb.density import Density, Regressions
from dopslam_ros.core.settings.layout import NONE, SP, VA, X, Y

# Standard deviations beyond the field of view at which a detection is out of the question.
MARGIN = 5.0
# A landmark becomes inactive this share of the field of view farther away than it becomes active.
HYSTERESIS = 0.1


@jit
def some_left_behind(density: Density, sp_field_of_view: float) -> bool:
    """Whether there is any track that ``left_behind`` finds."""
    _, leaving = left_behind(density, sp_field_of_view)
    for one in leaving:
        if one:
            return True
    return False


@from_python
def left_behind(density: Density, sp_field_of_view: float) -> tuple[FloatArray, BoolArray]:
    """Tracks of which every component is an SP too far away to be detected.

    Args:
        density: after a step.
        sp_field_of_view: [m].

    Returns:
        (C,) the distance of the vehicle [m] at which the components must be active again, and (T,)
        which tracks are left behind.
    """
    mean, covariance = density.mean, density.covariance
    component_track, component_type = density.component_track, density.component_type
    reactivation_distance = np.empty(len(component_track))
    leaving = np.full(len(density.track_id), True)
    margin = MARGIN * math.sqrt(covariance[X, X] + covariance[Y, Y])
    position, uncertainty = components_in_space(density)
    for c in range(len(component_track)):
        variance = uncertainty[c, 0, 0] + uncertainty[c, 1, 1] + uncertainty[c, 2, 2]
        reactivation_distance[c] = sp_field_of_view + MARGIN * math.sqrt(max(variance, 0.0))
        distance = math.hypot(position[c, 0] - mean[X], position[c, 1] - mean[Y])
        farthest = reactivation_distance[c] + margin + HYSTERESIS * sp_field_of_view
        if component_type[c] != SP or distance <= farthest:
            leaving[component_track[c]] = False
    return reactivation_distance, leaving


@from_python
def to_reactivate(
    position: FloatArray, reactivation_distance: FloatArray, ue: FloatArray, margin: float
) -> BoolArray:
    """Which of N landmarks are so near to the vehicle that they must be active.

    Args:
        position: (N, 3) [m].
        reactivation_distance: (N,) [m].
        ue: (2,) the vehicle [m].
        margin: how far it may be from there [m].
    """
    found = np.empty(len(reactivation_distance), np.bool_)
    for i in range(len(reactivation_distance)):
        distance = math.hypot(position[i, 0] - ue[X], position[i, 1] - ue[Y])
        found[i] = distance <= reactivation_distance[i] + margin
    return found


@from_python
def current(density: Density, regressions: Regressions) -> tuple[FloatArray, FloatArray]:
    """N inactive landmarks as they follow from their anchors, these being as they are now.

    Returns:
        (N, D) local coordinates and (N, D, D) their covariances, D numbers each.
    """
    size, n = regressions.q.shape[1], len(density.mean)
    q, covariance = np.empty_like(regressions.q), np.empty_like(regressions.residual)
    jacobian, cross = np.empty((size, n)), np.empty((size, n))
    for s in range(len(q)):
        follows = regress(density, regressions, s, jacobian, q[s])
        own = regressions.residual[s] if follows else regressions.covariance[s]
        multiply(jacobian, density.covariance, cross)
        for i in range(size):
            for j in range(i + 1):
                covariance[s, i, j] = own[i, j] + inner_product(cross[i], jacobian[j])
                covariance[s, j, i] = covariance[s, i, j]
    return q, covariance


@from_python
def reactivated(density: Density, regressions: Regressions) -> tuple[FloatArray, FloatArray]:
    """Mean and covariance of the joint vector with N inactive landmarks appended.

    With J = dq / d joint vector of all of them: covariance J P J' + residual, with the rest J P.

    Returns:
        (n + D N,) and (n + D N, n + D N), where each landmark has D numbers.
    """
    n, block = len(density.mean), regressions.q.shape[1]
    size = n + block * len(regressions.q)
    mean, joint = np.empty(size), np.empty((size, size))
    for i in range(n):
        mean[i] = density.mean[i]
        for j in range(n):
            joint[i, j] = density.covariance[i, j]
    jacobian, cross = np.empty((size - n, n)), np.empty((size - n, n))
    for s in range(len(regressions.q)):
        at = n + block * s
        rows, q = jacobian[at - n : at - n + block], mean[at : at + block]
        follows = regress(density, regressions, s, rows, q)
        own = regressions.residual[s] if follows else regressions.covariance[s]
        for i in range(block):
            for j in range(block):
                joint[at + i, at + j] = own[i, j]
    multiply(jacobian, density.covariance, cross)
    for i in range(n, size):
        for j in range(n):
            joint[i, j] = cross[i - n, j]
            joint[j, i] = cross[i - n, j]
        for j in range(n, i + 1):
            residual = joint[i, j] if (j - n) // block == (i - n) // block else 0.0
            joint[i, j] = residual + inner_product(cross[i - n], jacobian[j - n])
            joint[j, i] = joint[i, j]
    return mean, joint


@jit
def regress(
    density: Density, regressions: Regressions, s: int, jacobian: FloatArray, q: FloatArray
) -> bool:
    """q = q_then + gain (anchor_q - anchor_q_then); q_then alone where an anchor is gone.

    Args:
        density: as it is now.
        regressions: of all inactive landmarks.
        s: which of them.
        jacobian: (D, n) result: dq / d joint vector.
        q: (D,) result.

    Returns:
        Whether all its anchors are there.
    """
    jacobian.fill(0.0)
    for i in range(len(q)):
        q[i] = regressions.q[s, i]
    first = 0
    for k in range(regressions.anchors.shape[1]):
        if regressions.anchors[s, k] <= 0:  # those behind are not used either
            break
        anchor = component_of(density, regressions.anchors[s, k])
        if anchor == NONE:
            jacobian.fill(0.0)
            for i in range(len(q)):
                q[i] = regressions.q[s, i]
            return False
        begin, size = density.start[anchor], density.start[anchor + 1] - density.start[anchor]
        for i in range(len(q)):
            for j in range(size):
                gain = regressions.gain[s, i, first + j]
                jacobian[i, begin + j] += gain
                q[i] += gain * (density.mean[begin + j] - regressions.anchor_q[s, first + j])
        first += size
    return True


@jit
def component_of(density: Density, anchor: int) -> int:
    """The component of the virtual anchor with a track id, or NONE."""
    for c in range(len(density.component_type)):
        if density.component_type[c] == VA:
            if density.track_id[density.component_track[c]] == anchor:
                return c
    return NONE


@jit
def multiply(sparse: FloatArray, covariance: FloatArray, product: FloatArray) -> None:
    """product (m, n) = sparse (m, n) covariance (n, n); few numbers of ``sparse`` are not zero."""
    product.fill(0.0)
    for i in range(len(sparse)):
        for k in range(len(covariance)):
            if sparse[i, k] != 0.0:
                for j in range(len(covariance)):
                    product[i, j] += sparse[i, k] * covariance[k, j]


@jit
def inner_product(one: FloatArray, other: FloatArray) -> float:
    """The inner product of two vectors (n,)."""
    total = 0.0
    for k in range(len(one)):
        total += one[k] * other[k]
    return total
