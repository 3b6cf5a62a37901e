"""Landmarks as range and direction in frames of their own; see ``filter.placement``."""

from __future__ import annotations

import math

import numpy as np

from dopslam_ros.core.linalg.arrays import FloatArray
from dopslam_ros.core.linalg.jit import from_python, jit
from dopslam_ros.core.linalg.vec import SMALLEST_DISTANCE, Vec, cross, unit, vec
from dopslam_ros.core.pmb.density import Density
from dopslam_ros.core.settings.layout import SPACE

# A first axis that is this upright or more needs another helper than the vertical.
UPRIGHT = 0.9


@from_python
def frames(offset: FloatArray, axes: FloatArray) -> None:
    """Axes (M, 3, 3) whose first columns point along offsets (M, 3), or along x for no offset."""
    for m in range(len(offset)):
        _, u = unit(vec(offset[m]))
        if abs(u.z) > UPRIGHT:  # x cross first
            _, v = unit(Vec(0.0, -u.z, u.y))
        else:  # z cross first
            _, v = unit(Vec(-u.y, u.x, 0.0))
        w = cross(u, v)
        for i in range(SPACE):
            axes[m, i, 0], axes[m, i, 1], axes[m, i, 2] = u[i], v[i], w[i]


@jit
def place(origin: FloatArray, axes: FloatArray, q: FloatArray, position: FloatArray) -> None:
    """Writes the position (3,) of the landmark q (3,) in the frame origin (3,), axes (3, 3)."""
    reach = q[0] / math.sqrt(1.0 + q[1] * q[1] + q[2] * q[2])
    for i in range(SPACE):
        position[i] = origin[i] + reach * (axes[i, 0] + axes[i, 1] * q[1] + axes[i, 2] * q[2])


@from_python
def positions(origin: FloatArray, axes: FloatArray, q: FloatArray, position: FloatArray) -> None:
    """``place`` for M landmarks: (M, 3), (M, 3, 3), (M, 3); position (M, 3) is written."""
    for m in range(len(q)):
        place(origin[m], axes[m], q[m], position[m])


@from_python
def placements(origin: FloatArray, axes: FloatArray, position: FloatArray, q: FloatArray) -> None:
    """Writes q (M, 3) of positions (M, 3): the inverse of ``positions``.

    A position that is not in front of its frame has no tangents; they are finite all the same.
    """
    for m in range(len(position)):
        dx, dy, dz = (
            position[m, 0] - origin[m, 0],
            position[m, 1] - origin[m, 1],
            position[m, 2] - origin[m, 2],
        )
        own = axes[m]
        ahead = own[0, 0] * dx + own[1, 0] * dy + own[2, 0] * dz
        if abs(ahead) < SMALLEST_DISTANCE:
            ahead = SMALLEST_DISTANCE
        q[m, 0] = math.sqrt(dx * dx + dy * dy + dz * dz)
        q[m, 1] = (own[0, 1] * dx + own[1, 1] * dy + own[2, 1] * dz) / ahead
        q[m, 2] = (own[0, 2] * dx + own[1, 2] * dy + own[2, 2] * dz) / ahead


@jit
def place_jacobian(axes: FloatArray, q: FloatArray, jacobian: FloatArray) -> None:
    """Writes the derivative (3, 3) of the position of q (3,) by q, in a frame with axes (3, 3)."""
    length = math.sqrt(1.0 + q[1] * q[1] + q[2] * q[2])
    reach = q[0] / length
    r1, r2 = q[1] / length, q[2] / length
    for i in range(SPACE):
        along = (axes[i, 0] + axes[i, 1] * q[1] + axes[i, 2] * q[2]) / length
        jacobian[i, 0] = along
        jacobian[i, 1] = reach * (axes[i, 1] - along * r1)
        jacobian[i, 2] = reach * (axes[i, 2] - along * r2)


@from_python
def jacobians(axes: FloatArray, q: FloatArray, jacobian: FloatArray) -> None:
    """``place_jacobian`` for M landmarks: (M, 3, 3), (M, 3); jacobian (M, 3, 3) is written."""
    for m in range(len(q)):
        place_jacobian(axes[m], q[m], jacobian[m])


@from_python
def in_space(
    origin: FloatArray, axes: FloatArray, q: FloatArray, covariance: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """M landmarks in x, y, z, to first order.

    Args:
        origin: (M, 3) of their frames [m].
        axes: (M, 3, 3).
        q: (M, 3).
        covariance: (M, 3, 3) of q.

    Returns:
        (M, 3) positions [m] and (M, 3, 3) their covariances [m^2].
    """
    position, spread, jacobian = np.empty_like(q), np.empty_like(covariance), np.empty((3, 3))
    for m in range(len(q)):
        place(origin[m], axes[m], q[m], position[m])
        place_jacobian(axes[m], q[m], jacobian)
        transform(jacobian, covariance[m], 0, spread[m])
    return position, spread


@from_python
def components_in_space(density: Density) -> tuple[FloatArray, FloatArray]:
    """``in_space`` for the C components of a density."""
    count = len(density.component_track)
    position, spread = np.empty((count, 3)), np.empty((count, 3, 3))
    jacobian = np.empty((3, 3))
    for c in range(count):
        at = density.start[c]
        q = density.mean[at : density.start[c + 1]]
        place(density.origin[c], density.axes[c], q, position[c])
        place_jacobian(density.axes[c], q, jacobian)
        transform(jacobian, density.covariance, at, spread[c])
    return position, spread


@jit
def transform(jacobian: FloatArray, covariance: FloatArray, at: int, spread: FloatArray) -> None:
    """Writes J P J' into spread (3, 3), P the block of a covariance that begins at an index."""
    for i in range(SPACE):
        for j in range(i + 1):
            total = 0.0
            for k in range(SPACE):
                for m in range(SPACE):
                    total += jacobian[i, k] * covariance[at + k, at + m] * jacobian[j, m]
            spread[i, j] = total
            spread[j, i] = total
