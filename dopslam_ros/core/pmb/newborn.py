"""Which births are kept, and how they join the density, behind the components that are there.

Of the landmark born from a path, given that the path is no known landmark's, the existence is

    r = rho / (c + rho),    rho = sum over the types,

and the probability of a type its share of rho. A birth depends on the vehicle alone: with its local
coordinates q and the vehicle's s, q = q0 + gain (s - m) + noise of covariance ``residual``. That
gives its covariance with all that the vehicle is correlated with.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dopslam_ros.core.linalg.arrays import BoolArray, FloatArray, IntArray
from dopslam_ros.core.linalg.jit import jit, jit_inline
from dopslam_ros.core.linalg.vec import unit, vec
from dopslam_ros.core.pmb.birth import Births
from dopslam_ros.core.pmb.coordinates_kernels import frame_along
from dopslam_ros.core.pmb.density import Density, block_starts
from dopslam_ros.core.pmb.hypotheses import Hypotheses
from dopslam_ros.core.settings.filtering import Constants
from dopslam_ros.core.settings.layout import NONE, SPACE, UNKNOWN_TYPES, Components, X, Y


@jit_inline
def newborn(
    log_intensity: FloatArray, new: FloatArray, hypotheses: Hypotheses, prune_existence: float
) -> Newborn:
    """How likely the landmarks born from each path exist, and whether they are worth keeping.

    Args:
        log_intensity: (2, J) ln rho by type.
        new: (J,) ln (c + rho).
        hypotheses: which paths are free in each.
        prune_existence: existence below which a landmark would be pruned at once.
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
        kept[j] = existence[j] * free > prune_existence
    return Newborn(existence, kept)


@jit_inline
def augment(
    density: Density, births: Births, born: Newborn, numbered: BoolArray, constants: Constants
) -> tuple[Density, IntArray]:
    """Appends the births that are kept, each correlated with the vehicle as its fit says.

    Args:
        density: predicted, to which the births were fitted.
        births: candidates from J paths.
        born: which are kept.
        numbered: (J,) births that get an id, those kept among them: global hypotheses share ids.
        constants: pruning of types.

    Returns:
        The density with the births, and the (J,) track of the landmark born from each path.
    """
    track_id, existence, birth_track, next_id = appended_tracks(
        density.track_id, density.existence, density.next_id, born, numbered
    )
    path, kind, share = born_components(births.log_intensity, born.kept, constants.prune_type)
    components = len(density.component_track)
    total = components + len(path)
    origin, axes = np.empty((total, SPACE)), np.empty((total, SPACE, SPACE))
    owner, types = np.empty(total, np.int64), np.empty(total, np.int64)
    weight, displacement = np.empty(total), np.empty((len(path), SPACE))
    for c in range(components):
        owner[c], types[c] = density.component_track[c], density.component_type[c]
        weight[c] = density.component_weight[c]
        for i in range(SPACE):
            origin[c, i] = density.origin[c, i]
            for j in range(SPACE):
                axes[c, i, j] = density.axes[c, i, j]
    for birth in range(len(path)):
        at = components + birth
        origin[at, 0], origin[at, 1] = density.mean[X], density.mean[Y]
        origin[at, 2] = constants.ue_height
        owner[at], types[at] = birth_track[path[birth]], UNKNOWN_TYPES[kind[birth]]
        weight[at] = share[birth]
        for i in range(SPACE):
            displacement[birth, i] = births.position[kind[birth], path[birth], i] - origin[at, i]
        frame_along(vec(displacement[birth]), axes[at])
    own_axes = axes[components:]
    start = block_starts(density.start[0], types)
    mean, covariance = appended_gaussian(density, births, path, kind, displacement, own_axes, start)
    augmented = Density(
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
    )
    return augmented, birth_track


@jit
def appended_tracks(
    track_id: IntArray, existence: FloatArray, next_id: int, born: Newborn, numbered: BoolArray
) -> tuple[IntArray, FloatArray, IntArray, int]:
    """Ids and existence of T tracks with the births behind them; ``numbered`` (J,) get an id.

    Returns:
        (T + B,) ids, (T + B,) existence, (J,) tracks born from the paths, or NONE, and next id.
    """
    birth_track, total = np.full(len(numbered), NONE), len(track_id)
    for j in range(len(numbered)):
        if born.kept[j]:
            birth_track[j] = total
            total += 1
    ids, exist = np.empty(total, np.int64), np.empty(total)
    # Number by number: to put an array into a slice the compiler takes as long as for all the rest.
    for t in range(len(track_id)):
        ids[t], exist[t] = track_id[t], existence[t]
    for j in range(len(numbered)):
        if born.kept[j]:
            ids[birth_track[j]], exist[birth_track[j]] = next_id, born.existence[j]
        if numbered[j]:
            next_id += 1
    return ids, exist, birth_track, next_id


@jit
def born_components(
    log_intensity: FloatArray, kept: BoolArray, prune_type: float
) -> tuple[IntArray, IntArray, FloatArray]:
    """Components of the births that are kept, by path, then type.

    Args:
        log_intensity: (2, J) ln rho by type.
        kept: (J,).
        prune_type: types with a smaller share are dropped.

    Returns:
        (B,) the paths of the components, which of the ``UNKNOWN_TYPES`` they have, the types'
        probabilities.
    """
    most, count = len(UNKNOWN_TYPES) * len(kept), 0
    path, kind, share = np.empty(most, np.int64), np.empty(most, np.int64), np.empty(most)
    for j in range(len(kept)):
        if not kept[j]:
            continue
        high = max(log_intensity[0, j], log_intensity[1, j])
        first, second = math.exp(log_intensity[0, j] - high), math.exp(log_intensity[1, j] - high)
        total = first + second
        first = 0.0 if first < prune_type * total else first
        second = 0.0 if second < prune_type * total else second
        for k in range(len(UNKNOWN_TYPES)):
            part = first if k == 0 else second
            if part > 0.0:
                path[count], kind[count] = j, k
                share[count] = part / (first + second)
                count += 1
    return path[:count], kind[:count], share[:count]


@jit
def appended_gaussian(
    density: Density,
    births: Births,
    path: IntArray,
    kind: IntArray,
    displacement: FloatArray,
    axes: FloatArray,
    start: IntArray,
) -> tuple[FloatArray, FloatArray]:
    """Mean and covariance with B births behind the rest.

    Args:
        density: before.
        births: given in x, y, z.
        path: (B,) which of them.
        kind: (B,) of which type.
        displacement: (B, 3) from the vehicle [m], along which the first axes point.
        axes: (B, 3, 3).
        start: (C + B + 1,) where all blocks begin.
    """
    n, vehicle, before = len(density.mean), density.vehicle, len(density.start) - 1
    mean, covariance = np.zeros(start[-1]), np.zeros((start[-1], start[-1]))
    for i in range(n):
        mean[i] = density.mean[i]
        for j in range(n):
            covariance[i, j] = density.covariance[i, j]
    residual, gain = np.empty((SPACE, SPACE)), np.empty((SPACE, len(vehicle)))
    for birth in range(len(path)):
        k, j, at = kind[birth], path[birth], start[before + birth]
        mean[at] = local_regression(
            density.covariance,
            displacement[birth],
            axes[birth],
            births.covariance[k, j],
            births.gain[k, j],
            vehicle,
            residual,
            gain,
        )
        for c in range(SPACE):
            i = at + c
            # Columns up to here: the old ones, then the births before this one.
            for m in range(len(vehicle)):
                for other in range(i):
                    covariance[i, other] += gain[c, m] * covariance[m, other]
            for other in range(i):
                covariance[other, i] = covariance[i, other]
            own = residual[c, c]
            for m in range(len(vehicle)):
                own += gain[c, m] * covariance[m, i]
            for d in range(c):
                covariance[i, at + d] += residual[c, d]
                covariance[at + d, i] = covariance[i, at + d]
            covariance[i, i] = own
    return mean, covariance


@jit
def local_regression(
    covariance: FloatArray,
    displacement: FloatArray,
    axes: FloatArray,
    position_covariance: FloatArray,
    position_gain: FloatArray,
    vehicle: Components,
    residual: FloatArray,
    gain: FloatArray,
) -> float:
    """How the local coordinates q of a birth depend on the vehicle, its first axis pointing at it.

    With J = dq/dx: gain = J dx/ds, residual = J cov(x) J' - gain P gain'.

    Args:
        covariance: (n, n) of the joint vector, the vehicle's P (S, S) first.
        displacement: (3,) from the vehicle [m].
        axes: (3, 3) of the frame.
        position_covariance: (3, 3) cov(x) [m^2].
        position_gain: (3, S) dx/ds.
        vehicle: its components.
        residual: (3, 3) result.
        gain: (3, S) result: dq/ds.

    Returns:
        The first local coordinate: the distance from the vehicle [m].
    """
    local = np.empty((SPACE, SPACE))
    distance, _ = unit(vec(displacement))
    # dq/dx where the tangents are zero: the axes, those across scaled by the distance.
    for r in range(SPACE):
        scale = 1.0 if r == 0 else 1.0 / distance
        for c in range(SPACE):
            local[r, c] = axes[c, r] * scale
    for r in range(SPACE):
        for k in range(len(vehicle)):
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
            for i in range(len(vehicle)):
                for j in range(len(vehicle)):
                    total -= gain[r, i] * covariance[i, j] * gain[d, j]
            residual[r, d] = total
            residual[d, r] = total
    return distance


class Newborn(NamedTuple):
    """The landmarks that may be born from J paths.

    Attributes:
        existence: (J,) r = rho / (c + rho), where the path is given to no landmark.
        kept: (J,) whose landmark would not be pruned at once.
    """

    existence: FloatArray
    kept: BoolArray
