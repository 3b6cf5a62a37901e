"""Landmarks as range and direction from where they were first heard.

A young landmark is known to 0.1 m along the ray and to many metres across it. That density is bent:
it follows the sphere about the place it was heard from. In x, y, z no Gaussian fits it, and a
filter that linearises there believes what it cannot know. In range and direction it is a Gaussian.

A landmark is kept as q = (range [m], two tangents of the direction), in a frame of its own: an
origin and three axes, of which the first points to where the landmark was born. The tangents have
no singular direction and need no wrapping.
"""

from __future__ import annotations

from dopslam_ros.core.linalg.arrays import FloatArray, check_shapes, floats
from dopslam_ros.core.pmb import coordinates_kernels as kernels
from dopslam_ros.core.settings.layout import SPACE


def frames(displacement: FloatArray) -> FloatArray:
    """Axes of new landmarks.

    Args:
        displacement: (M, 3) from the origin to each landmark [m]; zero counts as along x.

    Returns:
        (M, 3, 3) rotations; their first columns point along ``displacement``.

    Raises:
        ValueError: it has another shape.
    """
    check_shapes(displacement=(displacement, (len(displacement), SPACE)))
    return kernels.frames(floats(displacement))


def positions(origin: FloatArray, axes: FloatArray, q: FloatArray) -> FloatArray:
    """(M, 3) positions [m] of landmarks q (M, 3) with origins (M, 3) and axes (M, 3, 3).

    Raises:
        ValueError: the shapes do not fit together.
    """
    count = len(q)
    _check(count, axes, q)
    check_shapes(origin=(origin, (count, SPACE)))
    return kernels.positions(floats(origin), floats(axes), floats(q))


def local_coordinates(origin: FloatArray, axes: FloatArray, position: FloatArray) -> FloatArray:
    """(M, 3) q of positions (M, 3) in front of the frames; the inverse of ``positions``.

    Raises:
        ValueError: the shapes do not fit together.
    """
    count = len(position)
    check_shapes(
        origin=(origin, (count, SPACE)),
        axes=(axes, (count, SPACE, SPACE)),
        position=(position, (count, SPACE)),
    )
    return kernels.local_coordinates(floats(origin), floats(axes), floats(position))


def jacobians(axes: FloatArray, q: FloatArray) -> FloatArray:
    """(M, 3, 3) derivatives of the positions with respect to q.

    Raises:
        ValueError: the shapes do not fit together.
    """
    _check(len(q), axes, q)
    return kernels.jacobians(floats(axes), floats(q))


def _check(count: int, axes: FloatArray, q: FloatArray) -> None:
    check_shapes(axes=(axes, (count, SPACE, SPACE)), q=(q, (count, SPACE)))
