"""Where a path touched the world, from few of its components."""

from __future__ import annotations

import math

import numpy as np

from dopslam_ros.core.linalg.arrays import BoolArray, FloatArray
from dopslam_ros.core.linalg.jit import jit
from dopslam_ros.core.linalg.vec import (
    SMALLEST_DISTANCE,
    Vec,
    between,
    distance_between,
    dot,
    moved,
    write_row,
)
from dopslam_ros.core.models.channel_kernels import Vehicle
from dopslam_ros.core.settings.layout import (
    AOA_AZIMUTH,
    AOA_ELEVATION,
    AOD_AZIMUTH,
    AOD_ELEVATION,
    SPACE,
    TOA,
)

# Rounds that settle an elevation that was not measured, and the largest sine it may have.
ELEVATION_ROUNDS = 10
STEEPEST = 0.9
# Rays that are more parallel than this (squared sine) do not cross.
PARALLEL = 1e-4


@jit
def measured_incidence_points(
    vehicle: Vehicle, bs: Vec, landmark_height_mean: float, values: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Where J paths touched the world, x_inc below eq. (4), and whether that can be told.

    Args:
        vehicle: where it is.
        bs: position of the base station [m].
        landmark_height_mean: prior of a landmark's height [m].
        values: (J, 6) z, NaN where not measured.

    Returns:
        (J, 3) points [m], beside the vehicle where that cannot be told, and (J,) whether it can.
    """
    points, located = np.empty((len(values), SPACE)), np.empty(len(values), np.bool_)
    for j in range(len(values)):
        located[j], point = incidence_point(vehicle, bs, landmark_height_mean, values[j])
        if not located[j]:
            here = vehicle.position
            point = Vec(here.x + 1.0, here.y + 1.0, here.z + 1.0)
        write_row(point, points, j)
    return points, located


@jit
def incidence_point(
    vehicle: Vehicle, bs: Vec, landmark_height_mean: float, z: FloatArray
) -> tuple[bool, Vec]:
    """Whether one path z (6,) says where it touched the world, and where [m].

    With a delay it is on an ellipsoid, in the direction of arrival, or else of departure; without
    it is where both rays pass closest.
    """
    ue, azimuth = vehicle.position, z[AOA_AZIMUTH] + vehicle.heading
    arrival, departure = math.isfinite(z[AOA_AZIMUTH]), math.isfinite(z[AOD_AZIMUTH])
    if not math.isfinite(z[TOA]):
        if not (arrival and departure):
            return False, ue
        u = ray(azimuth, z[AOA_ELEVATION])
        return closest_point(ue, u, bs, ray(z[AOD_AZIMUTH], z[AOD_ELEVATION]))
    length = z[TOA] - vehicle.clock_bias
    if not length > distance_between(ue, bs):
        return False, ue
    if not math.isfinite(z[AOA_ELEVATION]) and departure and math.isfinite(z[AOD_ELEVATION]):
        arrival = False  # the ray of departure is better known
    if arrival:
        return ellipsoid_point(ue, bs, azimuth, z[AOA_ELEVATION], length, landmark_height_mean)
    if departure:
        return ellipsoid_point(
            bs, ue, z[AOD_AZIMUTH], z[AOD_ELEVATION], length, landmark_height_mean
        )
    return False, ue


@jit
def ellipsoid_point(
    focus: Vec,
    other: Vec,
    azimuth: float,
    elevation: float,
    length: float,
    landmark_height_mean: float,
) -> tuple[bool, Vec]:
    """Where a ray from one focus meets the ellipsoid of points with that sum of distances.

    Args:
        focus: where the ray begins [m].
        other: the other focus [m].
        azimuth: of the ray, map frame [rad].
        elevation: of the ray [rad]; NaN to settle it towards the prior height.
        length: sum of the distances, more than that of the foci from each other [m].
        landmark_height_mean: prior height [m].

    Returns:
        Whether it meets it, and where [m].
    """
    unknown = math.isnan(elevation)
    if unknown:
        elevation = 0.0
    d = between(other, focus)
    excess = 0.5 * (length * length - d.x * d.x - d.y * d.y - d.z * d.z)
    met, point = False, focus
    for _ in range(ELEVATION_ROUNDS if unknown else 1):
        u = ray(azimuth, elevation)
        below = length + u.x * d.x + u.y * d.y + u.z * d.z
        met = abs(below) >= SMALLEST_DISTANCE
        distance = excess / below if met else 1.0
        point = moved(focus, distance, u)
        if unknown:
            ratio = (landmark_height_mean - focus.z) / max(distance, 1.0)
            elevation = math.asin(min(max(ratio, -STEEPEST), STEEPEST))
    return met, point


@jit
def closest_point(ue: Vec, arrival: Vec, bs: Vec, departure: Vec) -> tuple[bool, Vec]:
    """The midpoint [m] where the rays of arrival and departure pass closest, if that is ahead.

    Args:
        ue: position of the vehicle [m].
        arrival: unit vector of the ray from it.
        bs: position of the base station [m].
        departure: unit vector of the ray from there.

    Returns:
        Whether the rays are not parallel and the point is ahead on both, and the point.
    """
    u, w, d = arrival, departure, between(ue, bs)
    cosine = dot(u, w)
    sine = 1.0 - cosine * cosine
    if sine < PARALLEL:
        return False, ue
    on_u, on_w = dot(u, d), dot(w, d)
    along_u = (on_u - cosine * on_w) / sine
    along_w = (cosine * on_u - on_w) / sine
    point = Vec(
        0.5 * (ue.x + along_u * u.x + bs.x + along_w * w.x),
        0.5 * (ue.y + along_u * u.y + bs.y + along_w * w.y),
        0.5 * (ue.z + along_u * u.z + bs.z + along_w * w.z),
    )
    return min(along_u, along_w) > 0.0, point


@jit
def ray(azimuth: float, elevation: float) -> Vec:
    """Unit vector of a direction [rad]; an elevation of NaN counts as 0."""
    if math.isnan(elevation):
        elevation = 0.0
    ground = math.cos(elevation)
    return Vec(ground * math.cos(azimuth), ground * math.sin(azimuth), math.sin(elevation))


@jit
def virtual_anchor_of(vehicle: Vec, bs: Vec, incidence: Vec) -> Vec:
    """The VA behind the wall on which a path has its incidence point; all are positions [m]."""
    ratio = distance_between(bs, incidence)
    ratio /= max(distance_between(vehicle, incidence), SMALLEST_DISTANCE)
    return moved(incidence, ratio, between(vehicle, incidence))
