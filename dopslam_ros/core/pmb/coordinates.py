"""Landmarks as range and direction from where they were first heard.

A young landmark is known to 0.1 m along the ray and to many metres across it. That density is bent:
it follows the sphere about the place it was heard from. In x, y, z no Gaussian fits it, and a
filter that linearises there believes what it cannot know. In range and direction it is a Gaussian.

A landmark is kept as q = (range [m], two tangents of the direction), in a frame of its own: an
origin and three axes, of which the first points to where the landmark was born. The tangents have
no singular direction and need no wrapping.
"""

from __future__ import annotations

import numpy as np

from dopslam_ros.core.linalg.arrays import FloatArray, check_shapes, floats
from dopslam_ros.core.pmb import coordinates_kernels as kernels


def frames(offset: FloatArray) -> FloatArray:
    """Axes of new landmarks.

    Args:
        offset: (M, 3) from the origin to each landmark; one that is zero counts as along x.

    Returns:
        (M, 3, 3) rotations; their first columns point along ``offset``.
    """
    axes = np.empty((len(offset), 3, 3))
    check_shapes(offset=(offset, (len(axes), 3)))
    kernels.frames(floats(offset), axes)
    return axes


def positions(origin: FloatArray, axes: FloatArray, q: FloatArray) -> FloatArray:
    """(M, 3) positions [m] of landmarks q (M, 3) with origins (M, 3) and axes (M, 3, 3)."""
    position = _like_frames(origin, axes, q)
    kernels.positions(floats(origin), floats(axes), floats(q), position)
    return position


def placements(origin: FloatArray, axes: FloatArray, position: FloatArray) -> FloatArray:
    """(M, 3) q of positions (M, 3) in front of the frames; the inverse of ``positions``."""
    q = _like_frames(origin, axes, position)
    kernels.placements(floats(origin), floats(axes), floats(position), q)
    return q


def jacobians(axes: FloatArray, q: FloatArray) -> FloatArray:
    """(M, 3, 3) derivatives of the positions with respect to q."""
    jacobian = np.empty((len(q), 3, 3))
    check_shapes(axes=(axes, jacobian.shape), q=(q, (len(q), 3)))
    kernels.jacobians(floats(axes), floats(q), jacobian)
    return jacobian


def _like_frames(origin: FloatArray, axes: FloatArray, places: FloatArray) -> FloatArray:
    """Room for (M, 3), the M frames and places being as many."""
    count = len(places)
    check_shapes(
        origin=(origin, (count, 3)), axes=(axes, (count, 3, 3)), places=(places, (count, 3))
    )
    return np.empty((count, 3))
