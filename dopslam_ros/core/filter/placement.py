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

from dopslam_ros.core.arrays import FloatArray


def frames(offset: FloatArray) -> FloatArray:
    """Axes of new landmarks.

    Args:
        offset: (M, 3) from the origin to each landmark, not zero.

    Returns:
        (M, 3, 3) rotations; their first columns point along ``offset``.
    """
    first = offset / np.linalg.norm(offset, axis=1, keepdims=True)
    upright = np.abs(first[:, 2:]) > 0.9
    helper = np.where(upright, [[1.0, 0.0, 0.0]], [[0.0, 0.0, 1.0]])
    second = np.cross(helper, first)
    second /= np.linalg.norm(second, axis=1, keepdims=True)
    return np.stack([first, second, np.cross(first, second)], axis=2)


def positions(origin: FloatArray, axes: FloatArray, q: FloatArray) -> FloatArray:
    """(M, 3) positions [m] of landmarks q (M, 3) with origins (M, 3) and axes (M, 3, 3)."""
    direction = (axes @ _rays(q)[:, :, None])[:, :, 0]
    return np.asarray(origin + q[:, :1] * direction)


def placements(origin: FloatArray, axes: FloatArray, position: FloatArray) -> FloatArray:
    """(M, 3) q of positions (M, 3) in front of the frames; the inverse of ``positions``."""
    local = (np.swapaxes(axes, 1, 2) @ (position - origin)[:, :, None])[:, :, 0]
    reach = np.linalg.norm(local, axis=1, keepdims=True)
    return np.concatenate([reach, local[:, 1:] / local[:, :1]], axis=1)


def jacobians(axes: FloatArray, q: FloatArray) -> FloatArray:
    """(M, 3, 3) derivatives of the positions with respect to q."""
    ray = _rays(q)
    length = np.sqrt(1.0 + q[:, 1] ** 2 + q[:, 2] ** 2)
    across = np.eye(3) - ray[:, :, None] * ray[:, None, :]
    local = (q[:, 0] / length)[:, None, None] * across
    local[:, :, 0] = ray
    return np.asarray(axes @ local)


def _rays(q: FloatArray) -> FloatArray:
    """(M, 3) unit vectors of the directions, in the frames' axes."""
    ray = np.concatenate([np.ones((len(q), 1)), q[:, 1:]], axis=1)
    return np.asarray(ray / np.linalg.norm(ray, axis=1, keepdims=True))
