"""Which scattering points the vehicle has left behind, and how they are when it comes back."""

from __future__ import annotations

import math

import numpy as np

from dopslam_ros.core.linalg.arrays import BoolArray, FloatArray
from dopslam_ros.core.linalg.jit import from_python, jit
from dopslam_ros.core.pmb.coordinates_kernels import components_in_space
from dopslam_ros.core.pmb.density import Density, Regressions
from dopslam_ros.core.settings.layout import LANDMARK_SIZES, NONE, SP, VA, X, Y

# Standard deviations beyond the field of view at which a detection is out of the question.
MARGIN = 5.0
# A landmark becomes inactive this share of the field of view farther away than it wakes up.
HYSTERESIS = 0.1


@jit
def some_left_behind(density: Density, view: float) -> bool:
    """Whether there is any track that ``left_behind`` finds."""
    _, leaving = left_behind(density, view)
    for one in leaving:
        if one:
            return True
    return False


@from_python
def left_behind(density: Density, view: float) -> tuple[FloatArray, BoolArray]:
    """Tracks of which every component is an SP too far away to be detected.

    Args:
        density: after a step.
        view: the field of view [m].

    Returns:
        (C,) the distance at which the components must be active again [m], and (T,) which tracks
        are left behind.
    """
    mean, covariance = density.mean, density.covariance
    component_track, component_type = density.component_track, density.component_type
    reach = np.empty(len(component_track))
    leaving = np.full(len(density.track_id), True)
    blur = MARGIN * math.sqrt(covariance[X, X] + covariance[Y, Y])
    position, spread = components_in_space(density)
    for c in range(len(component_track)):
        variance = spread[c, 0, 0] + spread[c, 1, 1] + spread[c, 2, 2]
        reach[c] = view + MARGIN * math.sqrt(max(variance, 0.0))
        distance = math.hypot(position[c, 0] - mean[X], position[c, 1] - mean[Y])
        if component_type[c] != SP or distance <= reach[c] + blur + HYSTERESIS * view:
            leaving[component_track[c]] = False
    return reach, leaving


@from_python
def near(position: FloatArray, reach: FloatArray, ue: FloatArray, blur: float) -> BoolArray:
    """(N,) which places (N, 3) [m] are within their reach (N,) [m] and the blur of ue (2,) [m]."""
    found = np.empty(len(reach), np.bool_)
    for i in range(len(reach)):
        away = math.hypot(position[i, 0] - ue[0], position[i, 1] - ue[1])
        found[i] = away <= reach[i] + blur
    return found


@from_python
def as_of_now(density: Density, hanging: Regressions) -> tuple[FloatArray, FloatArray]:
    """N inactive landmarks as their anchors have it now.

    Returns:
        (N, 3) placements and (N, 3, 3) their covariances.
    """
    q, n = hanging.q, len(density.mean)
    places, spreads = np.empty_like(q), np.empty_like(hanging.residual)
    size = q.shape[1]
    rows, cross = np.empty((size, n)), np.empty((size, n))
    for s in range(len(q)):
        hangs = regress(density, hanging, s, rows, places[s])
        own = hanging.residual[s] if hangs else hanging.covariance[s]
        multiply(rows, density.covariance, cross)
        for i in range(size):
            for j in range(i + 1):
                spreads[s, i, j] = own[i, j] + inner(cross[i], rows[j])
                spreads[s, j, i] = spreads[s, i, j]
    return places, spreads


@from_python
def reactivated(density: Density, hanging: Regressions) -> tuple[FloatArray, FloatArray]:
    """Mean (n + 3 N,) and covariance of the joint vector with N inactive landmarks appended."""
    n, block = len(density.mean), hanging.q.shape[1]
    size = n + block * len(hanging.q)
    mean, joint = np.empty(size), np.empty((size, size))
    for i in range(n):
        mean[i] = density.mean[i]
        for j in range(n):
            joint[i, j] = density.covariance[i, j]
    rows, cross = np.empty((size - n, n)), np.empty((size - n, n))
    for s in range(len(hanging.q)):
        at = n + block * s
        depends = rows[at - n : at - n + block]
        hangs = regress(density, hanging, s, depends, mean[at : at + block])
        own = hanging.residual[s] if hangs else hanging.covariance[s]
        for i in range(block):
            for j in range(block):
                joint[at + i, at + j] = own[i, j]
    multiply(rows, density.covariance, cross)
    for i in range(n, size):
        for j in range(n):
            joint[i, j] = cross[i - n, j]
            joint[j, i] = cross[i - n, j]
        for j in range(n, i + 1):
            within = joint[i, j] if (j - n) // block == (i - n) // block else 0.0
            joint[i, j] = within + inner(cross[i - n], rows[j - n])
            joint[j, i] = joint[i, j]
    return mean, joint


@jit
def regress(
    density: Density, hanging: Regressions, s: int, rows: FloatArray, place: FloatArray
) -> bool:
    """How an inactive landmark depends on the joint vector; not at all where it has lost an anchor.

    Args:
        density: as it is now.
        hanging: of all inactive_landmarks.
        s: which of them.
        rows: (L, n) result: dq / d joint vector.
        place: (L,) result: q now.

    Returns:
        Whether all its anchors are there.
    """
    own, size = len(place), LANDMARK_SIZES[VA]
    rows.fill(0.0)
    for i in range(own):
        place[i] = hanging.q[s, i]
    for k in range(hanging.anchors.shape[1]):
        if hanging.anchors[s, k] <= 0:  # a place that is not used
            continue
        column = column_of(density, hanging.anchors[s, k])
        if column == NONE:
            rows.fill(0.0)
            for i in range(own):
                place[i] = hanging.q[s, i]
            return False
        for i in range(own):
            for j in range(size):
                by = hanging.gain[s, i, size * k + j]
                rows[i, column + j] += by
                place[i] += by * (density.mean[column + j] - hanging.anchor_q[s, size * k + j])
    return True


@jit
def column_of(density: Density, anchor: int) -> int:
    """Where in the joint vector the virtual anchor with an id is, or NONE."""
    for c in range(len(density.component_type)):
        if density.component_type[c] == VA:
            if density.track_id[density.component_track[c]] == anchor:
                return int(density.start[c])
    return NONE


@jit
def multiply(rows: FloatArray, covariance: FloatArray, product: FloatArray) -> None:
    """product (m, n) = rows (m, n) covariance (n, n); few of the rows' numbers are not zero."""
    product.fill(0.0)
    for i in range(len(rows)):
        for k in range(len(covariance)):
            if rows[i, k] != 0.0:
                for j in range(len(covariance)):
                    product[i, j] += rows[i, k] * covariance[k, j]


@jit
def inner(one: FloatArray, other: FloatArray) -> float:
    """The inner product of two vectors (n,)."""
    total = 0.0
    for k in range(len(one)):
        total += one[k] * other[k]
    return total
