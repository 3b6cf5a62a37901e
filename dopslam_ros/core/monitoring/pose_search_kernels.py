"""Where the vehicle is, from one set of paths and landmarks that are known."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dopslam_ros.core.linalg.arrays import BoolArray, FloatArray, IntArray
from dopslam_ros.core.linalg.jit import from_python, jit
from dopslam_ros.core.linalg.small import backward, cholesky, forward, log_determinant, used_places
from dopslam_ros.core.linalg.vec import Vec, between, unit, vec
from dopslam_ros.core.models.channel_kernels import mirrored, observe_source, wrapped
from dopslam_ros.core.models.incidence import ray
from dopslam_ros.core.settings.layout import (
    AOA_AZIMUTH,
    AOA_ELEVATION,
    AOD_AZIMUTH,
    AOD_ELEVATION,
    BS,
    CLOCK_BIAS,
    DIM,
    HEADING,
    NONE,
    SPACE,
    TOA,
    VA,
    X,
    Y,
)

LOG_2PI = math.log(2.0 * math.pi)
# Gauss-Newton: rounds, when a step is small enough, and the longest one [m].
ROUNDS = 12
SETTLED = 1e-3
LONGEST = 100.0
# As long as fewer paths than this are explained they are added one by one.
ONE_BY_ONE = 4
# Then all that fit at once, so often.
ALL_AT_ONCE = 3
# So much [nat] a start from the BS, whose place is certain, goes before one from a VA.
BS_FIRST = 1e6
# Farther than this nothing is heard [m].
FARTHEST = 3000.0


class World(NamedTuple):
    """What is known: the sensor and L landmarks, the first of them the BS.

    Attributes:
        bs: (3,) [m].
        ue_height: (1,) [m].
        speed: (1,) v [m/s].
        position: (L, 3) [m].
        covariance: (L, 3, 3) [m^2].
        kind: (L,) LandmarkType.
        log_heard: (L,) ln of the probability of a path where it is in view.
        sp_field_of_view: (1,) [m].
        damping: (U,) information that holds a step where the paths do not determine it.
    """

    bs: FloatArray
    ue_height: FloatArray
    speed: FloatArray
    position: FloatArray
    covariance: FloatArray
    kind: IntArray
    log_heard: FloatArray
    sp_field_of_view: FloatArray
    damping: FloatArray


class Heard(NamedTuple):
    """J paths.

    Attributes:
        values: (J, 6) NaN where not used.
        used: (J, 6).
        noise: (J, 6, 6).
        log_clutter: (J,) ln of the intensity of a path that is no landmark's.
        gate: (7,) squared distances inside which a path lies, by its number of components.
        possible: (L, J) what may come from which at all, whatever the pose.
    """

    values: FloatArray
    used: BoolArray
    noise: FloatArray
    log_clutter: FloatArray
    gate: FloatArray
    possible: BoolArray


class Room(NamedTuple):
    """Work space.

    Attributes:
        h: (6,).
        a: (6, U).
        b: (6, 3).
        s: (6, 6).
        v: (6,).
        place: (6,).
    """

    h: FloatArray
    a: FloatArray
    b: FloatArray
    s: FloatArray
    v: FloatArray
    place: IntArray


@jit
def room(vehicle: int) -> Room:
    """Work space for a vehicle of so many components."""
    return Room(
        np.empty(DIM),
        np.empty((DIM, vehicle)),
        np.empty((DIM, SPACE)),
        np.empty((DIM, DIM)),
        np.empty(DIM),
        np.empty(DIM, np.int64),
    )


@jit
def compare(
    pose: FloatArray, spread: FloatArray, world: World, m: int, heard: Heard, j: int, work: Room
) -> int:
    """Path j as landmark m's: v becomes L^-1 v and s its L, with S = A P A' + B C B' + R.

    Args:
        pose: (U,).
        spread: (U, U) P of the pose.
        world: of which m is a landmark.
        m: its number.
        heard: of which j is a path.
        j: its number.
        work: a is A, written.

    Returns:
        The number of components; 0 where there can be no such path.
    """
    degenerate, facing = observe_source(
        pose,
        world.speed[0],
        world.bs,
        world.ue_height[0],
        world.position[m],
        world.kind[m],
        work.h,
        work.a,
        work.b,
    )
    if degenerate or not facing:
        return 0
    count = used_places(heard.used[j], work.place)
    a, b, covariance = work.a, work.b, world.covariance[m]
    for k in range(count):
        c = work.place[k]
        work.v[k] = heard.values[j, c] - work.h[c]
        if c in (AOA_AZIMUTH, AOD_AZIMUTH):
            work.v[k] = wrapped(work.v[k])
        for i in range(k + 1):
            d = work.place[i]
            total = heard.noise[j, c, d]
            for p in range(len(pose)):
                part = 0.0
                for q in range(len(pose)):
                    part += spread[p, q] * a[d, q]
                total += a[c, p] * part
            if m > 0:
                for p in range(SPACE):
                    part = 0.0
                    for q in range(SPACE):
                        part += covariance[p, q] * b[d, q]
                    total += b[c, p] * part
            work.s[k, i] = total
    if not cholesky(work.s, count):
        return 0
    forward(work.s, work.v, count)
    return count


@jit
def squared(vector: FloatArray, count: int) -> float:
    """Sum of the first squares."""
    total = 0.0
    for k in range(count):
        total += vector[k] * vector[k]
    return total


@jit
def settle(
    pose: FloatArray,
    bias: FloatArray,
    world: World,
    heard: Heard,
    given: IntArray,
    spread: FloatArray,
    work: Room,
) -> float:
    """The pose, in place, at which the paths fit best, by Gauss-Newton.

    Args:
        pose: (U,) a start.
        bias: (2,) mean [m] and standard deviation [m] of the clock bias before.
        world: the landmarks.
        heard: the paths.
        given: (J,) landmark of each path, or NONE.
        spread: (U, U) result: covariance.
        work: space.

    Returns:
        Sum of the squared distances, that of the bias included; inf where they do not fit at all.
    """
    vehicle = len(pose)
    nowhere, information = np.zeros((vehicle, vehicle)), np.empty((vehicle, vehicle))
    step, column = np.empty(vehicle), np.empty(DIM)
    cost = math.inf
    for _ in range(ROUNDS):
        information.fill(0.0)
        for i in range(vehicle):
            information[i, i] = world.damping[i]
            step[i] = 0.0
        information[CLOCK_BIAS, CLOCK_BIAS] += 1.0 / (bias[1] * bias[1])
        off = bias[0] - pose[CLOCK_BIAS]
        step[CLOCK_BIAS] = off / (bias[1] * bias[1])
        cost = off * step[CLOCK_BIAS]
        for j in range(len(given)):
            if given[j] == NONE:
                continue
            count = compare(pose, nowhere, world, given[j], heard, j, work)
            if count == 0:
                return math.inf
            cost += squared(work.v, count)
            rows = np.empty((vehicle, count))
            for p in range(vehicle):
                for k in range(count):
                    column[k] = work.a[work.place[k], p]
                forward(work.s, column, count)
                for k in range(count):
                    rows[p, k] = column[k]
            for p in range(vehicle):
                for k in range(count):
                    step[p] += rows[p, k] * work.v[k]
                    for q in range(p + 1):
                        information[p, q] += rows[p, k] * rows[q, k]
        if not cholesky(information, vehicle):
            return math.inf
        forward(information, step, vehicle)
        backward(information, step, vehicle)
        length = math.sqrt(step[X] * step[X] + step[Y] * step[Y])
        scale = min(1.0, LONGEST / max(length, 1e-9))
        for i in range(vehicle):
            pose[i] += scale * step[i]
        pose[HEADING] = wrapped(pose[HEADING])
        if (
            length < SETTLED
            and abs(step[HEADING]) < 1e-3 * SETTLED
            and abs(step[CLOCK_BIAS]) < SETTLED
        ):
            break
    for p in range(vehicle):
        step.fill(0.0)
        step[p] = 1.0
        forward(information, step, vehicle)
        backward(information, step, vehicle)
        for q in range(vehicle):
            spread[q, p] = step[q]
    return cost


@jit
def start_from(world: World, m: int, z: FloatArray, bias: FloatArray, pose: FloatArray) -> bool:
    """The pose (U,) at which a path z (6,) is that of the BS or a VA, or whether there is none.

    The direction of departure, mirrored at the wall, is that of arrival in the map. The distance is
    that of the delay where the clock is known, else that at which the elevation fits the height.
    """
    if not (math.isfinite(z[AOA_AZIMUTH]) and math.isfinite(z[AOD_AZIMUTH])):
        return False
    wx, wy, wz = ray(z[AOD_AZIMUTH], z[AOD_ELEVATION])
    ux, uy, uz = -wx, -wy, -wz
    place = world.position[m]
    if world.kind[m] == VA:
        _, n = unit(between(vec(world.bs), vec(place)))
        ux, uy, uz = mirrored(Vec(wx, wy, wz), n)
    rise = place[2] - world.ue_height[0]
    ground = math.sqrt(ux * ux + uy * uy)
    if ground < 1e-6:
        return False
    reach = FARTHEST
    if math.isfinite(z[TOA]) and bias[1] < 0.1 * FARTHEST:
        slant = z[TOA] - bias[0]
        reach = math.sqrt(max(slant * slant - rise * rise, 1.0))
    else:
        slope = uz / ground
        if math.isfinite(z[AOA_ELEVATION]):
            slope = 0.5 * (slope + math.tan(z[AOA_ELEVATION]))
        if slope * rise > 0.0:
            reach = min(rise / slope, FARTHEST)
    pose[X] = place[0] - reach * ux / ground
    pose[Y] = place[1] - reach * uy / ground
    pose[HEADING] = wrapped(math.atan2(uy, ux) - z[AOA_AZIMUTH])
    pose[CLOCK_BIAS] = bias[0]
    if math.isfinite(z[TOA]) and bias[1] >= 0.1 * FARTHEST:
        pose[CLOCK_BIAS] = z[TOA] - math.sqrt(reach * reach + rise * rise)
    return True


@jit
def extend(
    pose: FloatArray,
    bias: FloatArray,
    world: World,
    heard: Heard,
    given: IntArray,
    spread: FloatArray,
    work: Room,
) -> float:
    """Gives more and more paths to landmarks, the clearest first, the pose following in place.

    Args:
        pose: (U,).
        bias: as for ``settle``.
        world: the landmarks.
        heard: the paths.
        given: (J,) landmark of each path, or NONE; more of them afterwards.
        spread: (U, U) of the pose.
        work: space.

    Returns:
        ln of the odds of these against no landmark at all, or -inf.
    """
    sources, paths = len(world.kind), len(given)
    taken = np.zeros(sources, np.bool_)
    number = 0
    for j in range(paths):
        if given[j] != NONE:
            taken[given[j]] = True
            number += 1
    gain, best = np.empty(paths), np.empty(paths, np.int64)
    rounds = 0
    while number < paths and rounds < ONE_BY_ONE + ALL_AT_ONCE:
        for j in range(paths):
            gain[j], best[j] = 0.0, NONE
            if given[j] != NONE:
                continue
            for m in range(sources):
                if taken[m] or not heard.possible[m, j] or beyond(pose, spread, world, m):
                    continue
                worth = odds_of(pose, spread, world, m, heard, j, work)
                if worth > gain[j]:
                    gain[j], best[j] = worth, m
        added = False
        order = np.argsort(-gain)
        for j in order:
            m = best[j]
            if m == NONE or taken[m]:
                continue
            given[j], taken[m], added = m, True, True
            number += 1
            if number <= ONE_BY_ONE:
                break
        if not added:
            break
        if not math.isfinite(settle(pose, bias, world, heard, given, spread, work)):
            return -math.inf
        rounds += 1
    if not drop_misfits(pose, bias, world, heard, given, spread, work):
        return -math.inf
    return total_odds(pose, bias, world, heard, given, spread, work)


@jit
def drop_misfits(
    pose: FloatArray,
    bias: FloatArray,
    world: World,
    heard: Heard,
    given: IntArray,
    spread: FloatArray,
    work: Room,
) -> bool:
    """Takes the path that fits worst from its landmark until all are in their gates.

    Returns:
        Whether any are left and the pose is settled.
    """
    nowhere = np.zeros((len(pose), len(pose)))
    while True:
        worst, most = NONE, 1.0
        some = False
        for j in range(len(given)):
            if given[j] == NONE:
                continue
            some = True
            count = compare(pose, nowhere, world, given[j], heard, j, work)
            excess = squared(work.v, count) / heard.gate[count] if count > 0 else math.inf
            if excess > most:
                worst, most = j, excess
        if worst == NONE:
            return some
        given[worst] = NONE
        if not math.isfinite(settle(pose, bias, world, heard, given, spread, work)):
            return False


@jit
def beyond(pose: FloatArray, spread: FloatArray, world: World, m: int) -> bool:
    """Whether an SP is out of view, five standard deviations granted."""
    if world.kind[m] == BS or world.kind[m] == VA:
        return False
    vehicle = Vec(pose[X], pose[Y], world.ue_height[0])
    distance, _ = unit(between(vehicle, vec(world.position[m])))
    blur: float = (
        spread[X, X] + spread[Y, Y] + world.covariance[m, 0, 0] + world.covariance[m, 1, 1]
    )
    reach: float = world.sp_field_of_view[0] + 5.0 * math.sqrt(blur)
    return distance > reach


@jit
def odds_of(
    pose: FloatArray, spread: FloatArray, world: World, m: int, heard: Heard, j: int, work: Room
) -> float:
    """ln of the odds of path j being landmark m's against nobody's; -inf outside the gate."""
    count = compare(pose, spread, world, m, heard, j, work)
    distance = squared(work.v, count)
    if count == 0 or distance > heard.gate[count]:
        return -math.inf
    density: float = -0.5 * (distance + count * LOG_2PI + log_determinant(work.s, count))
    density += world.log_heard[m] - heard.log_clutter[j]
    return density


@jit
def total_odds(
    pose: FloatArray,
    bias: FloatArray,
    world: World,
    heard: Heard,
    given: IntArray,
    spread: FloatArray,
    work: Room,
) -> float:
    """ln of the odds at a settled pose, integrated over the poses around (Laplace)."""
    nowhere = np.zeros((len(pose), len(pose)))
    total = 0.0
    for j in range(len(given)):
        if given[j] != NONE:
            total += odds_of(pose, nowhere, world, given[j], heard, j, work)
    lower = spread.copy()
    if not cholesky(lower, len(pose)):
        return -math.inf
    away: float = (pose[CLOCK_BIAS] - bias[0]) / bias[1]
    total += 0.5 * (len(pose) * LOG_2PI + log_determinant(lower, len(pose)) - away * away)
    return total


@from_python
def locate(
    world: World,
    heard: Heard,
    bias: FloatArray,
    most: int,
    poses: FloatArray,
    spreads: FloatArray,
    givens: IntArray,
    odds: FloatArray,
) -> int:
    """Poses from every path that may be the BS's or a VA's, and what else fits then.

    Args:
        world: the landmarks.
        heard: J paths.
        bias: (2,) mean and standard deviation of the clock bias before [m].
        most: seeds that are followed.
        poses: (N, U) result, not in order; N is J times the number of BS and VAs at least.
        spreads: (N, U, U) result.
        givens: (N, J) result: landmark of each path, or NONE.
        odds: (N,) result: ln of the odds against nobody's, up to a constant.

    Returns:
        How many there are.
    """
    work = room(poses.shape[1])
    count = 0
    for m in range(len(world.kind)):
        if world.kind[m] != BS and world.kind[m] != VA:
            continue
        for j in range(len(heard.values)):
            if not start_from(world, m, heard.values[j], bias, poses[count]):
                continue
            given = givens[count]
            given.fill(NONE)
            given[j] = m
            cost = settle(poses[count], bias, world, heard, given, spreads[count], work)
            if cost > heard.gate[DIM]:
                continue
            odds[count] = total_odds(poses[count], bias, world, heard, given, spreads[count], work)
            if world.kind[m] == BS:
                odds[count] += BS_FIRST
            count += 1
    order = np.argsort(-odds[:count])
    for number in range(count):
        n = order[number]
        if number >= most:
            odds[n] = -math.inf
            continue
        odds[n] = extend(poses[n], bias, world, heard, givens[n], spreads[n], work)
    return count
