"""Births worth keeping, put behind the components that are there."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dopslam_ros.core.linalg.arrays import BoolArray, FloatArray, IntArray
from dopslam_ros.core.linalg.jit import jit, jit_inline
from dopslam_ros.core.pmb.birth import Births
from dopslam_ros.core.pmb.coordinates_kernels import frames
from dopslam_ros.core.pmb.density import Density, block_starts
from dopslam_ros.core.pmb.hypotheses import Hypotheses
from dopslam_ros.core.settings.filtering import Constants
from dopslam_ros.core.settings.layout import LANDMARK_SIZES, NONE, SPACE, UNKNOWN_TYPES, X, Y


@jit_inline
def newborn(
    log_intensity: FloatArray, new: FloatArray, hypotheses: Hypotheses, least: float
) -> Newborn:
    """How likely the landmarks born from each path exist, and whether they are worth keeping.

    Args:
        log_intensity: (2, J) ln rho by type.
        new: (J,) ln (c + rho).
        hypotheses: which paths are free in each.
        least: existence below which a landmark would be pruned at once.
    """
    existence, kept = np.zeros(len(new)), np.empty(len(new), np.bool_)
    for j in range(len(new)):
        high = max(log_intensity[0, j], log_intensity[1, j])
        low = min(log_intensity[0, j], log_intensity[1, j])
        if high > -math.inf:
            existence[j] = math.exp(high - new[j]) * (1.0 + math.exp(low - high))
        free = 0.0
        for h in range(len(hypotheses.weight)):
            if hypotheses.track[h, j] == NONE:
                free += hypotheses.weight[h]
        kept[j] = existence[j] * free > least
    return Newborn(existence, kept)


@jit
def select_births(
    log_intensity: FloatArray, kept: BoolArray, least: float
) -> tuple[IntArray, IntArray, FloatArray]:
    """Components of the births that are kept, by path, then type.

    Args:
        log_intensity: (2, J) ln rho by type.
        kept: (J,).
        least: types with a smaller share are dropped.

    Returns:
        (B,) the path of each component, its type, 0 or 1, and the probability of the type.
    """
    most = 2 * len(kept)
    path, kind, share = np.empty(most, np.int64), np.empty(most, np.int64), np.empty(most)
    count = 0
    for j in range(len(kept)):
        if not kept[j]:
            continue
        high = max(log_intensity[0, j], log_intensity[1, j])
        first, second = math.exp(log_intensity[0, j] - high), math.exp(log_intensity[1, j] - high)
        total = first + second
        if first < least * total:
            first = 0.0
        if second < least * total:
            second = 0.0
        for k in range(2):
            part = first if k == 0 else second
            if part > 0.0:
                path[count], kind[count] = j, k
                share[count] = part / (first + second)
                count += 1
    return path[:count], kind[:count], share[:count]


@jit_inline
def augment(
    density: Density, births: Births, born: Newborn, numbered: BoolArray, constants: Constants
) -> tuple[Density, IntArray]:
    """Appends the births that are kept, each correlated with the vehicle as its fit says.

    Given the vehicle a birth depends on nothing else, so that it follows the vehicle's update.

    Args:
        density: predicted, to which the births were fitted.
        births: candidates from J paths.
        born: which are kept.
        numbered: (J,) births that get an id, those kept among them: global hypotheses share ids.
        constants: pruning of types.

    Returns:
        The density with the births, and the (J,) track of the landmark born from each path.
    """
    path, kind, share = select_births(births.log_intensity, born.kept, constants.prune_type)
    tracks, components, count = len(density.track_id), len(density.component_track), len(path)
    birth_track, new_tracks = np.full(len(numbered), NONE), 0
    for j in range(len(numbered)):
        if born.kept[j]:
            birth_track[j] = tracks + new_tracks
            new_tracks += 1
    track_id, existence = np.empty(tracks + new_tracks, np.int64), np.empty(tracks + new_tracks)
    # Number by number: to put an array into a slice the compiler takes as long as for all the rest.
    for t in range(tracks):
        track_id[t], existence[t] = density.track_id[t], density.existence[t]
    next_id = density.next_id
    for j in range(len(numbered)):
        if born.kept[j]:
            track_id[birth_track[j]], existence[birth_track[j]] = next_id, born.existence[j]
        if numbered[j]:
            next_id += 1
    total = components + count
    origin, axes = np.empty((total, SPACE)), np.empty((total, SPACE, SPACE))
    owner, types = np.empty(total, np.int64), np.empty(total, np.int64)
    weight, offset = np.empty(total), np.empty((count, SPACE))
    for c in range(components):
        owner[c], types[c] = density.component_track[c], density.component_type[c]
        weight[c] = density.component_weight[c]
        for i in range(SPACE):
            origin[c, i] = density.origin[c, i]
            for j in range(SPACE):
                axes[c, i, j] = density.axes[c, i, j]
    for birth in range(count):
        at = components + birth
        origin[at, 0], origin[at, 1] = density.mean[X], density.mean[Y]
        origin[at, 2] = constants.ue_height
        owner[at] = birth_track[path[birth]]
        types[at] = UNKNOWN_TYPES[kind[birth]]
        weight[at] = share[birth]
        for i in range(SPACE):
            offset[birth, i] = births.position[kind[birth], path[birth], i] - origin[at, i]
    own_axes = axes[components:]
    frames(offset, own_axes)
    start = block_starts(density.start[0], types)
    mean, covariance = append(density, births, path, kind, offset, own_axes, start)
    return (
        Density(
            mean,
            covariance,
            density.vehicle,
            start,
            origin,
            axes,
            owner,
            types,
            weight,
            track_id,
            existence,
            density.undetected,
            next_id,
        ),
        birth_track,
    )


@jit
def append(
    density: Density,
    births: Births,
    path: IntArray,
    kind: IntArray,
    offset: FloatArray,
    axes: FloatArray,
    start: IntArray,
) -> tuple[FloatArray, FloatArray]:
    """Mean and covariance with B births behind the rest.

    Args:
        density: before.
        births: given in x, y, z.
        path: (B,) which of them.
        kind: (B,) of which type.
        offset: (B, 3) from the vehicle [m], along which the first axes point.
        axes: (B, 3, 3) of their frames.
        start: (C + B + 1,) where the blocks of the old and new components begin.
    """
    n, vehicle = len(density.mean), density.start[0]
    total = start[-1]
    mean, covariance = np.zeros(total), np.zeros((total, total))
    for i in range(n):
        mean[i] = density.mean[i]
        for j in range(n):
            covariance[i, j] = density.covariance[i, j]
    for birth in range(len(path)):
        k, j = kind[birth], path[birth]
        at = start[len(start) - 1 - len(path) + birth]
        size = LANDMARK_SIZES[UNKNOWN_TYPES[k]]
        spread, gain = np.zeros((size, size)), np.zeros((size, vehicle))
        birth_in_frame(
            density.covariance,
            offset[birth],
            axes[birth],
            births.covariance[k, j],
            births.gain[k, j],
            spread,
            gain,
        )
        x, y, z = offset[birth, 0], offset[birth, 1], offset[birth, 2]
        mean[at] = math.sqrt(x * x + y * y + z * z)
        for c in range(size):
            i = at + c
            # Columns up to here: the old ones, then the births before this one.
            for m in range(vehicle):
                for other in range(i):
                    covariance[i, other] += gain[c, m] * covariance[m, other]
            for other in range(i):
                covariance[other, i] = covariance[i, other]
            own = spread[c, c]
            for m in range(vehicle):
                own += gain[c, m] * covariance[m, i]
            for d in range(c):
                covariance[i, at + d] += spread[c, d]
                covariance[at + d, i] = covariance[i, at + d]
            covariance[i, i] = own
    return mean, covariance


@jit
def birth_in_frame(
    covariance: FloatArray,
    offset: FloatArray,
    axes: FloatArray,
    position_covariance: FloatArray,
    position_gain: FloatArray,
    spread: FloatArray,
    gain: FloatArray,
) -> None:
    """A birth in its frame, of which the first axis points at it from the vehicle.

    Args:
        covariance: (n, n) of the joint vector, the vehicle first.
        offset: (3,) from the vehicle [m].
        axes: (3, 3) of the frame.
        position_covariance: (3, 3) [m^2].
        position_gain: (3, U) d position / ds.
        spread: (3, 3) result: covariance of q given the vehicle.
        gain: (3, U) result: dq/ds.
    """
    local, vehicle = np.empty((SPACE, SPACE)), gain.shape[1]
    reach = math.sqrt(offset[0] ** 2 + offset[1] ** 2 + offset[2] ** 2)
    # dq/dx where the tangents are zero: the axes, those across scaled by the range.
    for r in range(SPACE):
        scale = 1.0 if r == 0 else 1.0 / reach
        for c in range(SPACE):
            local[r, c] = axes[c, r] * scale
    for r in range(SPACE):
        for k in range(vehicle):
            total = 0.0
            for c in range(SPACE):
                total += local[r, c] * position_gain[c, k]
            gain[r, k] = total
    for r in range(SPACE):
        for d in range(r + 1):
            total = 0.0
            for i in range(SPACE):
                for j in range(SPACE):
                    total += local[r, i] * position_covariance[i, j] * local[d, j]
            for i in range(vehicle):
                for j in range(vehicle):
                    total -= gain[r, i] * covariance[i, j] * gain[d, j]
            spread[r, d] = total
            spread[d, r] = total


class Newborn(NamedTuple):
    """The landmarks that may be born from J paths.

    Attributes:
        existence: (J,) r = rho / (c + rho), where the path is given to no landmark.
        kept: (J,) whose landmark would not be pruned at once.
    """

    existence: FloatArray
    kept: BoolArray
