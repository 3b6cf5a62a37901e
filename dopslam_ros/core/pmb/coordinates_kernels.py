"""Landmarks as range and direction in frames of their own; see ``coordinates``."""

from __future__ import annotations

import math

import numpy as np

from dopslam_ros.core.linalg.arrays import FloatArray
from dopslam_ros.core.linalg.jit import from_python, jit
from dopslam_ros.core.linalg.vec import (
    SMALLEST_DISTANCE,
    Vec,
    between,
    cross,
    moved,
    unit,
    vec,
    write_row,
)
from dopslam_ros.core.pmb.density import Density
from dopslam_ros.core.settings.layout import SPACE

# A first axis that is this upright or more needs another helper than the vertical.
UPRIGHT = 0.9


@from_python
def frames(displacement: FloatArray) -> FloatArray:
    """Axes (M, 3, 3) whose first columns point along displacements (M, 3); along x for none."""
    axes = np.empty((len(displacement), SPACE, SPACE))
    for m in range(len(displacement)):
        frame_along(vec(displacement[m]), axes[m])
    return axes


@jit
def frame_along(displacement: Vec, axes: FloatArray) -> None:
    """Writes axes (3, 3), in columns, of which the first points along a displacement."""
    _, u = unit(displacement)
    if abs(u.z) > UPRIGHT:  # x cross first
        _, v = unit(Vec(0.0, -u.z, u.y))
    else:  # z cross first
        _, v = unit(Vec(-u.y, u.x, 0.0))
    w = cross(u, v)
    for i in range(SPACE):
        axes[i, 0], axes[i, 1], axes[i, 2] = u[i], v[i], w[i]


@jit
def ray_of(axes: FloatArray, q: FloatArray) -> tuple[float, Vec]:
    """Length of the vector along which a landmark q (3,) is, a_1 + q_2 a_2 + q_3 a_3, then it."""
    return math.sqrt(1.0 + q[1] * q[1] + q[2] * q[2]), Vec(
        axes[0, 0] + axes[0, 1] * q[1] + axes[0, 2] * q[2],
        axes[1, 0] + axes[1, 1] * q[1] + axes[1, 2] * q[2],
        axes[2, 0] + axes[2, 1] * q[1] + axes[2, 2] * q[2],
    )


@jit
def position_of(origin: FloatArray, axes: FloatArray, q: FloatArray) -> Vec:
    """Position of the landmark q (3,) in the frame with origin (3,) [m] and axes (3, 3)."""
    length, ray = ray_of(axes, q)
    return moved(vec(origin), q[0] / length, ray)


@jit
def position_jacobian(axes: FloatArray, q: FloatArray, jacobian: FloatArray) -> None:
    """Writes the derivative (3, 3) of the position of q (3,) by q, in a frame with axes (3, 3)."""
    length, ray = ray_of(axes, q)
    scale = q[0] / length
    for i in range(SPACE):
        along = ray[i] / length
        jacobian[i, 0] = along
        jacobian[i, 1] = scale * (axes[i, 1] - along * (q[1] / length))
        jacobian[i, 2] = scale * (axes[i, 2] - along * (q[2] / length))


@from_python
def positions(origin: FloatArray, axes: FloatArray, q: FloatArray) -> FloatArray:
    """``position_of`` M landmarks: origin (M, 3), axes (M, 3, 3), q (M, 3)."""
    position = np.empty((len(q), SPACE))
    for m in range(len(q)):
        write_row(position_of(origin[m], axes[m], q[m]), position, m)
    return position


@from_python
def jacobians(axes: FloatArray, q: FloatArray) -> FloatArray:
    """``position_jacobian`` of M landmarks, (M, 3, 3): axes (M, 3, 3), q (M, 3)."""
    jacobian = np.empty((len(q), SPACE, SPACE))
    for m in range(len(q)):
        position_jacobian(axes[m], q[m], jacobian[m])
    return jacobian


@from_python
def local_coordinates(origin: FloatArray, axes: FloatArray, position: FloatArray) -> FloatArray:
    """q (M, 3) of positions (M, 3): the inverse of ``positions``.

    A position that is not in front of its frame has no tangents; they are finite all the same.
    """
    q = np.empty((len(position), SPACE))
    for m in range(len(position)):
        d, own = between(vec(origin[m]), vec(position[m])), axes[m]
        ahead = own[0, 0] * d.x + own[1, 0] * d.y + own[2, 0] * d.z
        if abs(ahead) < SMALLEST_DISTANCE:
            ahead = SMALLEST_DISTANCE
        q[m, 0] = math.sqrt(d.x * d.x + d.y * d.y + d.z * d.z)
        q[m, 1] = (own[0, 1] * d.x + own[1, 1] * d.y + own[2, 1] * d.z) / ahead
        q[m, 2] = (own[0, 2] * d.x + own[1, 2] * d.y + own[2, 2] * d.z) / ahead
    return q


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
    position, result = np.empty((len(q), SPACE)), np.empty((len(q), SPACE, SPACE))
    jacobian = np.empty((SPACE, SPACE))
    for m in range(len(q)):
        write_row(position_of(origin[m], axes[m], q[m]), position, m)
        position_jacobian(axes[m], q[m], jacobian)
        block_congruence(jacobian, covariance[m], 0, result[m])
    return position, result


@from_python
def components_in_space(density: Density) -> tuple[FloatArray, FloatArray]:
    """``in_space`` for the C components of a density."""
    count = len(density.component_track)
    position, result = np.empty((count, SPACE)), np.empty((count, SPACE, SPACE))
    jacobian = np.empty((SPACE, SPACE))
    for c in range(count):
        first, axes = density.start[c], density.axes[c]
        q = density.mean[first : density.start[c + 1]]
        write_row(position_of(density.origin[c], axes, q), position, c)
        position_jacobian(axes, q, jacobian)
        block_congruence(jacobian, density.covariance, first, result[c])
    return position, result


@jit
def block_congruence(
    jacobian: FloatArray, covariance: FloatArray, first: int, result: FloatArray
) -> None:
    """Writes J P J' (3, 3), P the block (3, 3) of a covariance that begins at an index."""
    for i in range(SPACE):
        for j in range(i + 1):
            total = 0.0
            for k in range(SPACE):
                for m in range(SPACE):
                    total += jacobian[i, k] * covariance[first + k, first + m] * jacobian[j, m]
            result[i, j] = total
            result[j, i] = total
