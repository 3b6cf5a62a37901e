"""What can be detected from where, and what is left undetected."""

from __future__ import annotations

import math

from dopslam_ros.core.arrays import FloatArray, IntArray
from dopslam_ros.core.kernels.channel import SP
from dopslam_ros.core.kernels.compiled import compiled

# A distance that is better known than this [m] is as good as exact.
SMALLEST_SPREAD = 1e-9
# Even what is always detected leaves a chance to have been missed.
LARGEST_PROBABILITY = 1.0 - 1e-9


@compiled
def detection_probability(
    kind: int, distance: float, spread: float, probability: float, view: float
) -> float:
    """p_D of one landmark.

    Args:
        kind: LandmarkType.
        distance: from the vehicle [m].
        spread: standard deviation of the distance [m]; 0 where it is exact.
        probability: p_D of a visible landmark.
        view: field of view for SPs [m].
    """
    if kind != SP:
        return probability
    if spread <= SMALLEST_SPREAD:
        return probability if distance <= view else 0.0
    return probability * 0.5 * math.erfc((distance - view) / (spread * math.sqrt(2.0)))


@compiled
def detection_probabilities(
    ue: FloatArray,
    positions: FloatArray,
    types: IntArray,
    spread: FloatArray,
    probability: float,
    view: float,
    detection: FloatArray,
) -> None:
    """``detection_probability`` of M landmarks, into detection (M,).

    Args:
        ue: (3,) position of the vehicle [m].
        positions: (M, 3) [m].
        types: (M,) LandmarkType.
        spread: (M,) standard deviations of the distances [m].
        probability: p_D of a visible landmark.
        view: field of view for SPs [m].
        detection: (M,) to be written.
    """
    for m in range(len(types)):
        distance = apart(ue[0], ue[1], ue[2], positions[m])
        detection[m] = detection_probability(types[m], distance, spread[m], probability, view)


@compiled
def log_shares_left(
    looks: int,
    viewpoints: FloatArray,
    viewpoint_looks: IntArray,
    ue_height: float,
    positions: FloatArray,
    types: IntArray,
    spread: FloatArray,
    probability: float,
    view: float,
    floor: float,
    log_share: FloatArray,
) -> None:
    """ln of the share of undetected landmarks left at M places, into log_share (M,).

    Args:
        looks: number of snapshots so far.
        viewpoints: (K, 2) places of the vehicle [m].
        viewpoint_looks: (K,) number of snapshots near each.
        ue_height: z of the vehicle's antenna [m].
        positions: (M, 3) [m].
        types: (M,) VA or SP.
        spread: (M,) standard deviations of the distances [m].
        probability: p_D of a visible landmark.
        view: field of view for SPs [m].
        floor: share that always remains.
        log_share: (M,) to be written.
    """
    everywhere = looks * math.log1p(-min(probability, LARGEST_PROBABILITY))
    least = math.log(floor)
    for m in range(len(types)):
        total = everywhere
        if types[m] == SP:
            total = 0.0
            for k in range(len(viewpoints)):
                away = apart(viewpoints[k, 0], viewpoints[k, 1], ue_height, positions[m])
                seen = detection_probability(types[m], away, spread[m], probability, view)
                total += viewpoint_looks[k] * math.log1p(-min(seen, LARGEST_PROBABILITY))
        log_share[m] = max(total, least)


@compiled
def add_log_detection(
    ue: FloatArray,
    ue_height: float,
    positions: FloatArray,
    types: IntArray,
    spread: FloatArray,
    probability: float,
    view: float,
    log_share: FloatArray,
) -> None:
    """Adds ln p_D to log_share (M,), -inf where nothing can be detected; the rest as above.

    Args:
        ue: (4,) the vehicle now.
        ue_height, positions, types, spread, probability, view: as in ``log_shares_left``.
        log_share: (M,) to be added to.
    """
    for m in range(len(types)):
        distance = apart(ue[0], ue[1], ue_height, positions[m])
        seen = detection_probability(types[m], distance, spread[m], probability, view)
        log_share[m] += math.log(seen) if seen > 0.0 else -math.inf


@compiled
def apart(x: float, y: float, z: float, position: FloatArray) -> float:
    """Distance of a point from position (3,) [m]."""
    dx, dy, dz = position[0] - x, position[1] - y, position[2] - z
    return math.sqrt(dx * dx + dy * dy + dz * dz)


@compiled
def nearest_viewpoint(viewpoints: FloatArray, x: float, y: float) -> tuple[int, float, float]:
    """Which viewpoint (K, 2) is nearest to (x, y); its distance and that of the farthest [m].

    Returns:
        Index, -1 if there is none; the two distances.
    """
    index, least, most = -1, math.inf, 0.0
    for k in range(len(viewpoints)):
        distance = math.hypot(viewpoints[k, 0] - x, viewpoints[k, 1] - y)
        if distance < least:
            index, least = k, distance
        most = max(most, distance)
    return index, least, most
