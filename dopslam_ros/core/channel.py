"""The channel: what a landmark looks like from the vehicle, h(x, s), and its derivatives.

Every function works on a batch of landmarks at once. The order of the measured components is that
of eq. (3): path length (delay times c), azimuth and elevation of arrival, azimuth and elevation of
departure, Doppler.
"""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import numpy as np

from dopslam_ros.core.arrays import BoolArray, FloatArray, IntArray, wrap_angle

COMPONENTS = (
    "path_length",
    "aoa_azimuth",
    "aoa_elevation",
    "aod_azimuth",
    "aod_elevation",
    "doppler",
)
DIM = len(COMPONENTS)
DOPPLER = COMPONENTS.index("doppler")
AZIMUTHS = (1, 3)

# Two points closer than this [m] have no direction from one to the other.
SMALLEST_DISTANCE = 1e-6


class LandmarkType(IntEnum):
    """m in the paper. The numbers are those of dopslam_msgs/Landmark."""

    BS = 0
    VA = 1
    SP = 2


class Paths(NamedTuple):
    """Expected measurements of a batch of M landmarks and their Jacobians.

    Attributes:
        mean: (M, 6) h(x, s).
        ue_jacobian: (M, 6, 4) A = dh/ds.
        landmark_jacobian: (M, 6, 3) B = dh/dx; zero for a BS, whose place is known.
        degenerate: (M,) the geometry has no answer (vehicle or BS at the landmark, vehicle exactly
            under it, VA at the BS). The row is then finite but means nothing; Jacobians are zero.
        facing: (M,) the path can exist: for a VA, vehicle and BS are on the same side of the wall.
    """

    mean: FloatArray
    ue_jacobian: FloatArray
    landmark_jacobian: FloatArray
    degenerate: BoolArray
    facing: BoolArray


def observe(
    state: FloatArray,
    speed: float,
    positions: FloatArray,
    types: IntArray,
    bs_position: FloatArray,
    ue_height: float = 0.0,
) -> Paths:
    """h(x, s) of eqs. (4)-(11) with the Jacobians A and B of Section III-C.

    A VA is seen in its own direction at its own distance (the mirror image of the BS); its
    departure direction is the arrival direction mirrored at the wall. No incidence point is
    divided by, so nothing blows up when the vehicle comes near the wall.

    Args:
        state: (4,) x [m], y [m], heading [rad], clock bias [m].
        speed: v [m/s], for the Doppler.
        positions: (M, 3) landmark positions [m], map frame; ignored for a BS.
        types: (M,) LandmarkType.
        bs_position: (3,) [m].
        ue_height: z of the vehicle's antenna [m].
    """
    rays = _trace(state, positions, types, bs_position, ue_height)
    heading = np.array([np.cos(state[2]), np.sin(state[2]), 0.0])
    sideways = np.array([-heading[1], heading[0], 0.0])

    mean = np.empty((len(types), DIM))
    mean[:, 0] = rays.distance + np.where(rays.is_sp, rays.leg, 0.0) + state[3]
    mean[:, 1], mean[:, 2] = _angles(rays.arrival)
    mean[:, 1] = wrap_angle(mean[:, 1] - state[2])
    mean[:, 3], mean[:, 4] = _angles(rays.departure)
    mean[:, 5] = rays.arrival @ (speed * heading)

    by_ue, by_landmark = _position_jacobians(rays, speed * heading)
    ue_jacobian = np.zeros((len(types), DIM, 4))
    ue_jacobian[:, :, :2] = by_ue[:, :, :2]
    ue_jacobian[:, 1, 2] = -1.0
    ue_jacobian[:, 5, 2] = rays.arrival @ (speed * sideways)
    ue_jacobian[:, 0, 3] = 1.0
    ue_jacobian[rays.degenerate] = 0.0
    by_landmark[rays.degenerate] = 0.0
    return Paths(mean, ue_jacobian, by_landmark, rays.degenerate, rays.facing)


class _Rays(NamedTuple):
    """Lines of M paths: to where they arrive from, and from the BS to the landmark.

    Attributes:
        is_bs: (M,).
        is_va: (M,).
        is_sp: (M,).
        distance: (M,) from the vehicle to the landmark [m].
        arrival: (M, 3) unit vector to it, q_AOA.
        leg: (M,) from the BS to the landmark; for the BS, to the vehicle [m].
        leg_direction: (M, 3) unit vector along it; for a VA the normal of its wall.
        departure: (M, 3) unit vector, q_AOD.
        degenerate: as in Paths.
        facing: as in Paths.
    """

    is_bs: BoolArray
    is_va: BoolArray
    is_sp: BoolArray
    distance: FloatArray
    arrival: FloatArray
    leg: FloatArray
    leg_direction: FloatArray
    departure: FloatArray
    degenerate: BoolArray
    facing: BoolArray


def _trace(
    state: FloatArray,
    positions: FloatArray,
    types: IntArray,
    bs_position: FloatArray,
    ue_height: float,
) -> _Rays:
    ue = np.array([state[0], state[1], ue_height])
    is_bs, is_va, is_sp = (types == kind for kind in LandmarkType)
    target = np.where(is_bs[:, None], bs_position, positions)
    to_target = target - ue
    distance, arrival = _normalise(to_target)
    leg, leg_direction = _normalise(np.where(is_bs[:, None], -to_target, target - bs_position))
    departure = np.where(is_va[:, None], _mirror(-arrival, leg_direction), leg_direction)
    degenerate = (
        (distance < SMALLEST_DISTANCE)
        | (leg < SMALLEST_DISTANCE)
        | (np.hypot(to_target[:, 0], to_target[:, 1]) < SMALLEST_DISTANCE)
        | (np.hypot(departure[:, 0], departure[:, 1]) < SMALLEST_DISTANCE)
    )
    # Signed distance of the vehicle from the wall, the BS being at the negative side.
    beyond_wall = np.einsum("mi,mi->m", ue - 0.5 * (target + bs_position), leg_direction)
    facing = ~degenerate & (~is_va | (beyond_wall < -SMALLEST_DISTANCE))
    return _Rays(
        is_bs, is_va, is_sp, distance, arrival, leg, leg_direction, departure, degenerate, facing
    )


def _position_jacobians(rays: _Rays, velocity: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Derivatives (M, 6, 3) of h by the position of the vehicle and by that of the landmark."""
    arrival, normal = rays.arrival, rays.leg_direction
    distance = np.maximum(rays.distance, SMALLEST_DISTANCE)[:, None]
    leg = np.maximum(rays.leg, SMALLEST_DISTANCE)[:, None, None]
    across = (np.eye(3) - arrival[:, :, None] * arrival[:, None, :]) / distance[:, :, None]
    across_leg = (np.eye(3) - normal[:, :, None] * normal[:, None, :]) / leg
    by_arrival, by_departure = _angle_jacobian(arrival), _angle_jacobian(rays.departure)

    by_landmark = np.empty((len(arrival), DIM, 3))
    by_landmark[:, 0] = arrival + np.where(rays.is_sp[:, None], normal, 0.0)
    by_landmark[:, 1:3] = by_arrival @ across
    by_landmark[:, 5] = (velocity - (arrival @ velocity)[:, None] * arrival) / distance
    by_ue = -by_landmark
    by_ue[:, 0] = -arrival

    # The departure: along the leg for BS and SP, mirrored at the wall for a VA.
    kinds = [rays.is_bs[:, None, None], rays.is_va[:, None, None]]
    mirrored = _mirror(across, normal)
    turned = _mirror_derivative(-arrival, normal, across_leg)
    by_ue[:, 3:5] = by_departure @ np.select(kinds, [across_leg, mirrored], 0.0)
    by_landmark[:, 3:5] = by_departure @ np.select(
        kinds, [np.zeros_like(mirrored), turned - mirrored], across_leg
    )
    by_landmark[rays.is_bs] = 0.0
    return by_ue, by_landmark


def incidence_points(
    state: FloatArray,
    positions: FloatArray,
    types: IntArray,
    bs_position: FloatArray,
    ue_height: float = 0.0,
) -> FloatArray:
    """Where each path meets its landmark, x_inc below eq. (4), (M, 3) [m]; for drawing.

    For a VA the point where the line to it crosses the wall, for an SP the SP itself, for the BS
    the BS. NaN where a VA's line does not cross the wall between vehicle and VA.
    """
    ue = np.array([state[0], state[1], ue_height])
    target = np.where((types == LandmarkType.BS)[:, None], bs_position, positions)
    _, normal = _normalise(target - bs_position)
    along = np.einsum("mi,mi->m", target - ue, normal)
    height = np.einsum("mi,mi->m", 0.5 * (target + bs_position) - ue, normal)
    crosses = (height > SMALLEST_DISTANCE) & (along > height)
    fraction = np.where(crosses, height / np.where(crosses, along, 1.0), np.nan)
    point = ue + fraction[:, None] * (target - ue)
    return np.where((types == LandmarkType.VA)[:, None], point, target)


def residual(measured: FloatArray, expected: FloatArray) -> FloatArray:
    """Innovation z - h (..., 6) with the azimuths wrapped; NaN where nothing was measured."""
    difference = np.asarray(measured - expected, dtype=np.float64)
    for azimuth in AZIMUTHS:
        difference[..., azimuth] = wrap_angle(difference[..., azimuth])
    return difference


def _normalise(vectors: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Lengths (M,) and unit vectors (M, 3); a vector of no length points along x."""
    length = np.sqrt(np.einsum("mi,mi->m", vectors, vectors))
    short = length < SMALLEST_DISTANCE
    unit = vectors / np.where(short, 1.0, length)[:, None]
    unit[short] = (1.0, 0.0, 0.0)
    return length, unit


def _angles(direction: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Azimuth and elevation of unit vectors (M, 3), eqs. (6), (7)."""
    ground = np.hypot(direction[:, 0], direction[:, 1])
    return np.arctan2(direction[:, 1], direction[:, 0]), np.arctan2(direction[:, 2], ground)


def _angle_jacobian(direction: FloatArray) -> FloatArray:
    """Derivatives (M, 2, 3) of azimuth and elevation by a unit vector (M, 3)."""
    x, y, z = direction.T
    ground = np.maximum(np.hypot(x, y), SMALLEST_DISTANCE)
    jacobian = np.zeros((len(direction), 2, 3))
    jacobian[:, 0, 0] = -y / ground**2
    jacobian[:, 0, 1] = x / ground**2
    jacobian[:, 1, 0] = -z * x / ground
    jacobian[:, 1, 1] = -z * y / ground
    jacobian[:, 1, 2] = ground
    return jacobian


def _mirror(vectors: FloatArray, normal: FloatArray) -> FloatArray:
    """(I - 2 n n') applied to (M, 3) vectors or to the columns of (M, 3, k) matrices."""
    if vectors.ndim == 2:
        along = np.einsum("mi,mi->m", normal, vectors)
        return np.asarray(vectors - 2.0 * normal * along[:, None])
    rows = np.einsum("mi,mik->mk", normal, vectors)
    return np.asarray(vectors - 2.0 * normal[:, :, None] * rows[:, None, :])


def _mirror_derivative(
    vector: FloatArray, normal: FloatArray, normal_jacobian: FloatArray
) -> FloatArray:
    """d/dx of (I - 2 n n') u for fixed u (M, 3), given dn/dx (M, 3, 3)."""
    along = np.einsum("mi,mi->m", normal, vector)[:, None, None]
    turned = np.einsum("mi,mij->mj", vector, normal_jacobian)
    return np.asarray(-2.0 * (along * normal_jacobian + normal[:, :, None] * turned[:, None, :]))
