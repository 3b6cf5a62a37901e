"""How well paths fit landmarks from a pose, and the pose at which they fit best.

With path j given to landmark m(j), whose position x_m has the covariance C_m,

    z_j - h(x_m, s) = A ds + noise of covariance S_j = R_j + B C_m B',

so that by Gauss-Newton the information is the sum of A' S_j^-1 A, and ds follows from the sum of
A' S_j^-1 (z_j - h).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dopslam_ros.core.linalg.arrays import FloatArray, IntArray
from dopslam_ros.core.linalg.jit import jit
from dopslam_ros.core.linalg.small import (
    cholesky,
    forward,
    invert,
    log_determinant,
    solve,
    used_indices,
)
from dopslam_ros.core.linalg.vec import vec
from dopslam_ros.core.models.channel_kernels import observe_source, vehicle_of, wrapped
from dopslam_ros.core.monitoring.pose_problem import POSE, Problem
from dopslam_ros.core.settings.layout import (
    AZIMUTHS,
    BS,
    CLOCK_BIAS,
    DIM,
    HEADING,
    NONE,
    SPACE,
    X,
    Y,
)

LOG_2PI = math.log(2.0 * math.pi)
# Gauss-Newton: rounds, when a step is small enough, and the longest one [m].
ROUNDS = 12
SETTLED = 1e-3
LONGEST = 100.0
# Holds a step where the paths do not determine it: 1 / [m, m, rad, m]^2.
DAMPING = (1e-6, 1e-6, 1e-2, 1e-8)


class Workspace(NamedTuple):
    """One path against one landmark; k of its components count.

    Attributes:
        h: (6,) expected path.
        a: (6, 4) A = dh/ds.
        b: (6, 3) B = dh/dx.
        s: (6, 6) S in the first k rows, then its Cholesky factor L.
        v: (6,) L^-1 (z - h) in the first k entries.
        components: (6,) first those that count.
    """

    h: FloatArray
    a: FloatArray
    b: FloatArray
    s: FloatArray
    v: FloatArray
    components: IntArray


@jit
def new_workspace() -> Workspace:
    """Room for a path and a landmark."""
    return Workspace(
        np.empty(DIM),
        np.empty((DIM, len(POSE))),
        np.empty((DIM, SPACE)),
        np.empty((DIM, DIM)),
        np.empty(DIM),
        np.empty(DIM, np.int64),
    )


@jit
def compare(
    problem: Problem, pose: FloatArray, covariance: FloatArray, m: int, j: int, work: Workspace
) -> int:
    """Path j as landmark m's: S = A P A' + B C B' + R, its factor L, and L^-1 (z - h).

    Args:
        problem: of which m is a landmark and j a path.
        pose: (4,).
        covariance: (4, 4) P of the pose.
        m: the landmark.
        j: the path.
        work: written.

    Returns:
        The number of components; 0 where there can be no such path.
    """
    landmarks, paths = problem.landmarks, problem.paths
    degenerate, facing = observe_source(
        vehicle_of(pose, problem.ue_height, problem.speed),
        vec(problem.bs),
        vec(landmarks.position[m]),
        landmarks.kind[m],
        work.h,
        work.a,
        work.b,
    )
    if degenerate or not facing:
        return 0
    count = used_indices(paths.used[j], work.components)
    for k in range(count):
        c = work.components[k]
        work.v[k] = paths.values[j, c] - work.h[c]
        if c in AZIMUTHS:
            work.v[k] = wrapped(work.v[k])
        for i in range(k + 1):
            d = work.components[i]
            total = add_bilinear(paths.noise[j, c, d], work.a, covariance, c, d)
            if landmarks.kind[m] != BS:
                total = add_bilinear(total, work.b, landmarks.covariance[m], c, d)
            work.s[k, i] = total
    if not cholesky(work.s, count):
        return 0
    forward(work.s, work.v, count)
    return count


@jit
def add_bilinear(
    total: float, jacobian: FloatArray, covariance: FloatArray, c: int, d: int
) -> float:
    """A sum and J_c P J_d', rows c and d of a Jacobian (6, n) and a covariance (n, n)."""
    for p in range(len(covariance)):
        part = 0.0
        for q in range(len(covariance)):
            part += covariance[p, q] * jacobian[d, q]
        total += jacobian[c, p] * part
    return total


@jit
def squared_length(vector: FloatArray, count: int) -> float:
    """Sum of the squares of so many entries."""
    total = 0.0
    for k in range(count):
        total += vector[k] * vector[k]
    return total


@jit
def normal_equations(
    problem: Problem,
    pose: FloatArray,
    assigned: IntArray,
    information: FloatArray,
    gradient: FloatArray,
    work: Workspace,
) -> float:
    """Information (4, 4), of which the lower triangle is written, and gradient (4,) at a pose.

    Returns:
        Sum of the squared distances, that of the clock bias included; inf where there is no such
        path.
    """
    exact = np.zeros(information.shape)
    information.fill(0.0)
    for i in range(len(POSE)):
        information[i, i] = DAMPING[i]
        gradient[i] = 0.0
    variance = problem.clock.std * problem.clock.std
    off: float = problem.clock.mean - pose[CLOCK_BIAS]
    information[CLOCK_BIAS, CLOCK_BIAS] += 1.0 / variance
    gradient[CLOCK_BIAS] = off / variance
    cost: float = off * gradient[CLOCK_BIAS]
    column, rows = np.empty(DIM), np.empty((len(pose), DIM))
    for j in range(len(assigned)):
        if assigned[j] == NONE:
            continue
        count = compare(problem, pose, exact, assigned[j], j, work)
        if count == 0:
            return math.inf
        cost += squared_length(work.v, count)
        for p in range(len(pose)):
            for k in range(count):
                column[k] = work.a[work.components[k], p]
            forward(work.s, column, count)
            for k in range(count):
                rows[p, k] = column[k]
        for p in range(len(pose)):
            for k in range(count):
                gradient[p] += rows[p, k] * work.v[k]
                for q in range(p + 1):
                    information[p, q] += rows[p, k] * rows[q, k]
    return cost


@jit
def settle(
    problem: Problem,
    pose: FloatArray,
    assigned: IntArray,
    covariance: FloatArray,
    work: Workspace,
) -> float:
    """The pose, in place, at which the paths fit best, by Gauss-Newton.

    Args:
        problem: landmarks and paths.
        pose: (4,) where to start.
        assigned: (J,) landmark of each path, or NONE.
        covariance: (4, 4) result: of the pose.
        work: space.

    Returns:
        Sum of the squared distances, that of the clock bias included; inf where they do not fit at
        all.
    """
    information, step = np.empty((len(pose), len(pose))), np.empty(len(pose))
    cost = math.inf
    for _ in range(ROUNDS):
        cost = normal_equations(problem, pose, assigned, information, step, work)
        if cost == math.inf or not cholesky(information, len(pose)):
            return math.inf
        solve(information, step, len(pose))
        length = math.sqrt(step[X] * step[X] + step[Y] * step[Y])
        scale = min(1.0, LONGEST / max(length, 1e-9))
        for i in range(len(pose)):
            pose[i] += scale * step[i]
        pose[HEADING] = wrapped(pose[HEADING])
        turned, shifted = abs(step[HEADING]), abs(step[CLOCK_BIAS])
        if length < SETTLED and turned < 1e-3 * SETTLED and shifted < SETTLED:
            break
    invert(information, len(pose), covariance)
    return cost


@jit
def path_log_odds(
    problem: Problem, pose: FloatArray, covariance: FloatArray, m: int, j: int, work: Workspace
) -> float:
    """ln of the odds of path j being landmark m's against clutter; -inf outside the gate."""
    count = compare(problem, pose, covariance, m, j, work)
    distance = squared_length(work.v, count)
    if count == 0 or distance > problem.gates[count]:
        return -math.inf
    log_odds: float = -0.5 * (distance + count * LOG_2PI + log_determinant(work.s, count))
    log_odds += problem.landmarks.log_detection[m] - problem.paths.log_clutter[j]
    return log_odds


@jit
def total_log_odds(
    problem: Problem,
    pose: FloatArray,
    assigned: IntArray,
    covariance: FloatArray,
    work: Workspace,
) -> float:
    """ln of the odds at a settled pose, integrated over the poses around (Laplace)."""
    exact = np.zeros((len(pose), len(pose)))
    total = 0.0
    for j in range(len(assigned)):
        if assigned[j] != NONE:
            total += path_log_odds(problem, pose, exact, assigned[j], j, work)
    lower = covariance.copy()
    if not cholesky(lower, len(pose)):
        return -math.inf
    off: float = (pose[CLOCK_BIAS] - problem.clock.mean) / problem.clock.std
    total += 0.5 * (len(pose) * LOG_2PI + log_determinant(lower, len(pose)) - off * off)
    return total
