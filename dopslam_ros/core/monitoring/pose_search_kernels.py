"""The poses that one set of paths allows: from each path of the BS or a VA, what else fits."""

from __future__ import annotations

import math

import numpy as np

from dopslam_ros.core.linalg.arrays import BoolArray, FloatArray, IntArray
from dopslam_ros.core.linalg.jit import from_python, jit
from dopslam_ros.core.linalg.vec import Vec, between, horizontal, scaled, unit, vec
from dopslam_ros.core.models.channel_kernels import azimuth, mirrored, wrapped
from dopslam_ros.core.models.incidence import ray
from dopslam_ros.core.monitoring.pose_fit import (
    Workspace,
    compare,
    new_workspace,
    path_log_odds,
    settle,
    squared_length,
    total_log_odds,
)
from dopslam_ros.core.monitoring.pose_problem import POSE, Problem
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
    SP,
    TOA,
    VA,
    X,
    Y,
)

# As long as fewer paths than this are explained they are added one by one.
ONE_BY_ONE = 4
# Then all that fit at once, so often.
ALL_AT_ONCE = 3
# So much [nat] a start from the BS, whose position is certain, goes before one from a VA.
BS_FIRST = 1e6
# Farther than this nothing is heard [m].
FARTHEST = 3000.0
# Standard deviations beyond the field of view at which an SP is not looked for.
MARGIN = 5.0


@from_python
def locate(problem: Problem, most: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Poses from every path that may be the BS's or a VA's, and what else fits then.

    Args:
        problem: landmarks and J paths.
        most: starts that are followed.

    Returns:
        (N, 4) poses, not in order, (N, 4, 4) their covariances, and (N,) ln of the odds of the
        paths being the landmarks' against clutter, up to a constant.
    """
    kind, values = problem.landmarks.kind, problem.paths.values
    room = 0
    for m in range(len(kind)):
        room += len(values) if kind[m] != SP else 0
    poses, covariances = np.empty((room, len(POSE))), np.empty((room, len(POSE), len(POSE)))
    assigned, log_odds = np.full((room, len(values)), NONE), np.empty(room)
    work, count = new_workspace(), 0
    for m in range(len(kind)):
        if kind[m] == SP:
            continue
        for j in range(len(values)):
            pose, covariance = poses[count], covariances[count]
            if not pose_from_path(problem, m, values[j], pose):
                continue
            assigned[count].fill(NONE)
            assigned[count, j] = m
            cost = settle(problem, pose, assigned[count], covariance, work)
            if cost > problem.gates[DIM]:
                continue
            log_odds[count] = total_log_odds(problem, pose, assigned[count], covariance, work)
            if kind[m] == BS:
                log_odds[count] += BS_FIRST
            count += 1
    order = np.argsort(-log_odds[:count])
    for number in range(count):
        n = order[number]
        if number >= most:
            log_odds[n] = -math.inf
            continue
        log_odds[n] = extend(problem, poses[n], assigned[n], covariances[n], work)
    return poses[:count], covariances[:count], log_odds[:count]


@jit
def pose_from_path(problem: Problem, m: int, z: FloatArray, pose: FloatArray) -> bool:
    """The pose (4,) at which a path z (6,) is that of the BS or a VA, or whether there is none.

    The direction of departure, mirrored at the wall, is that of arrival in the map. The distance is
    that of the delay where the clock is known, else that at which the elevation fits the height.
    """
    if not (math.isfinite(z[AOA_AZIMUTH]) and math.isfinite(z[AOD_AZIMUTH])):
        return False
    clock, bs, position = problem.clock, problem.bs, problem.landmarks.position[m]
    departure = ray(z[AOD_AZIMUTH], z[AOD_ELEVATION])
    arrival = scaled(-1.0, departure)
    if problem.landmarks.kind[m] == VA:
        _, normal = unit(between(vec(bs), vec(position)))
        arrival = mirrored(departure, normal)
    height = position[2] - problem.ue_height
    ground = horizontal(arrival)
    if ground < 1e-6:
        return False
    distance = FARTHEST  # on the ground
    delayed, clock_known = math.isfinite(z[TOA]), clock.std < 0.1 * FARTHEST
    if delayed and clock_known:
        slant = z[TOA] - clock.mean
        distance = math.sqrt(max(slant * slant - height * height, 1.0))
    else:
        slope = arrival.z / ground
        if math.isfinite(z[AOA_ELEVATION]):
            slope = 0.5 * (slope + math.tan(z[AOA_ELEVATION]))
        if slope * height > 0.0:
            distance = min(height / slope, FARTHEST)
    pose[X] = position[0] - distance * arrival.x / ground
    pose[Y] = position[1] - distance * arrival.y / ground
    pose[HEADING] = wrapped(azimuth(arrival) - z[AOA_AZIMUTH])
    pose[CLOCK_BIAS] = clock.mean
    if delayed and not clock_known:
        pose[CLOCK_BIAS] = z[TOA] - math.sqrt(distance * distance + height * height)
    return True


@jit
def extend(
    problem: Problem,
    pose: FloatArray,
    assigned: IntArray,
    covariance: FloatArray,
    work: Workspace,
) -> float:
    """Gives more and more paths to landmarks, the clearest first, the pose following in place.

    Args:
        problem: landmarks and paths.
        pose: (4,).
        assigned: (J,) landmark of each path, or NONE; more of them afterwards.
        covariance: (4, 4) of the pose.
        work: space.

    Returns:
        ln of the odds of these against no landmark at all, or -inf.
    """
    taken, number = np.zeros(len(problem.landmarks.kind), np.bool_), 0
    for j in range(len(assigned)):
        if assigned[j] != NONE:
            taken[assigned[j]] = True
            number += 1
    rounds = 0
    while number < len(assigned) and rounds < ONE_BY_ONE + ALL_AT_ONCE:
        gain, best = best_landmarks(problem, pose, assigned, covariance, taken, work)
        added = False
        for j in np.argsort(-gain):
            m = best[j]
            if m == NONE or taken[m]:
                continue
            assigned[j], taken[m], added = m, True, True
            number += 1
            if number <= ONE_BY_ONE:
                break
        if not added:
            break
        if not math.isfinite(settle(problem, pose, assigned, covariance, work)):
            return -math.inf
        rounds += 1
    if not drop_misfits(problem, pose, assigned, covariance, work):
        return -math.inf
    return total_log_odds(problem, pose, assigned, covariance, work)


@jit
def best_landmarks(
    problem: Problem,
    pose: FloatArray,
    assigned: IntArray,
    covariance: FloatArray,
    taken: BoolArray,
    work: Workspace,
) -> tuple[FloatArray, IntArray]:
    """For each path that has no landmark the best of those that no path has, taken (L,).

    Returns:
        (J,) ln of the odds against clutter, and (J,) the landmark; 0 and NONE where clutter is
        likelier.
    """
    gain, best = np.zeros(len(assigned)), np.full(len(assigned), NONE)
    for j in range(len(assigned)):
        if assigned[j] != NONE:
            continue
        for m in range(len(taken)):
            possible = not taken[m] and problem.paths.possible[m, j]
            if not possible or out_of_view(problem, pose, covariance, m):
                continue
            log_odds = path_log_odds(problem, pose, covariance, m, j, work)
            if log_odds > gain[j]:
                gain[j], best[j] = log_odds, m
    return gain, best


@jit
def drop_misfits(
    problem: Problem,
    pose: FloatArray,
    assigned: IntArray,
    covariance: FloatArray,
    work: Workspace,
) -> bool:
    """Takes the path that fits worst from its landmark until all are in their gates.

    Returns:
        Whether any are left and the pose is settled.
    """
    exact = np.zeros((len(pose), len(pose)))
    while True:
        worst, most = NONE, 1.0
        some = False
        for j in range(len(assigned)):
            if assigned[j] == NONE:
                continue
            some = True
            count = compare(problem, pose, exact, assigned[j], j, work)
            excess = math.inf
            if count > 0:
                excess = squared_length(work.v, count) / problem.gates[count]
            if excess > most:
                worst, most = j, excess
        if worst == NONE:
            return some
        assigned[worst] = NONE
        if not math.isfinite(settle(problem, pose, assigned, covariance, work)):
            return False


@jit
def out_of_view(problem: Problem, pose: FloatArray, covariance: FloatArray, m: int) -> bool:
    """Whether landmark m is an SP too far away, five standard deviations granted."""
    landmarks = problem.landmarks
    if landmarks.kind[m] != SP:
        return False
    vehicle = Vec(pose[X], pose[Y], problem.ue_height)
    distance, _ = unit(between(vehicle, vec(landmarks.position[m])))
    variance: float = (
        covariance[X, X]
        + covariance[Y, Y]
        + landmarks.covariance[m, 0, 0]
        + landmarks.covariance[m, 1, 1]
    )
    farthest: float = problem.sp_field_of_view + MARGIN * math.sqrt(variance)
    return distance > farthest
