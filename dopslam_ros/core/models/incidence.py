"""Where a path touched the world, from few of its components."""

from __future__ import annotations

import math

import numpy as np

from dopslam_ros.core.linalg.arrays import BoolArray, FloatArray
from dopslam_ros.core.linalg.jit import jit
from dopslam_ros.core.linalg.vec import SMALLEST_DISTANCE

# Rounds that settle an elevation that was not measured, and the largest sine it may have.
ELEVATION_ROUNDS = 10
STEEPEST = 0.9
# Rays that are more parallel than this (squared sine) do not cross.
PARALLEL = 1e-4


@jit
def incidence_points(
    ue: FloatArray,
    ue_height: float,
    bs: FloatArray,
    height_mean: float,
    values: FloatArray,
    points: FloatArray,
    located: BoolArray,
) -> None:
    """Where J paths touched the world, from few of their components.

    Args:
        ue: (4,) the vehicle.
        ue_height: [m].
        bs: (3,) [m].
        height_mean: prior of a landmark's height [m].
        values: (J, 6) z, NaN where not measured.
        points: (J, 3) to be written [m]; beside the vehicle where not located.
        located: (J,) to be written: whether the path can be located.
    """
    vehicle = np.array([ue[0], ue[1], ue_height])
    direct = math.sqrt((bs[0] - ue[0]) ** 2 + (bs[1] - ue[1]) ** 2 + (bs[2] - ue_height) ** 2)
    for j in range(len(values)):
        z = values[j]
        azimuth, point = z[1] + ue[2], points[j]
        arrival = math.isfinite(z[1])
        departure = math.isfinite(z[3])
        if not math.isfinite(z[2]) and departure and math.isfinite(z[4]):
            arrival = False  # the ray of departure is better known
        found = False
        if not math.isfinite(z[0]):
            found = math.isfinite(z[1]) and departure
            found = found and closest_point(vehicle, bs, azimuth, z[2], z[3], z[4], point)
        elif z[0] - ue[3] > direct:
            length = z[0] - ue[3]
            if arrival:
                found = ellipsoid_point(vehicle, bs, azimuth, z[2], length, height_mean, point)
            elif departure:
                found = ellipsoid_point(bs, vehicle, z[3], z[4], length, height_mean, point)
        located[j] = found
        if not found:
            for i in range(3):
                point[i] = vehicle[i] + 1.0


@jit
def ellipsoid_point(
    focus: FloatArray,
    other: FloatArray,
    azimuth: float,
    elevation: float,
    length: float,
    height_mean: float,
    point: FloatArray,
) -> bool:
    """Where a ray from one focus meets the ellipsoid of points with that sum of distances.

    Args:
        focus: (3,) [m].
        other: (3,) the other focus [m].
        azimuth: of the ray, map frame [rad].
        elevation: of the ray [rad]; NaN to settle it towards the prior height.
        length: sum of the distances, more than the foci are apart [m].
        height_mean: prior height [m].
        point: (3,) to be written [m].

    Returns:
        Whether it meets it.
    """
    unknown = math.isnan(elevation)
    if unknown:
        elevation = 0.0
    dx, dy, dz = focus[0] - other[0], focus[1] - other[1], focus[2] - other[2]
    excess = 0.5 * (length * length - dx * dx - dy * dy - dz * dz)
    met = False
    for _ in range(ELEVATION_ROUNDS if unknown else 1):
        x, y, z = ray(azimuth, elevation)
        below = length + x * dx + y * dy + z * dz
        met = abs(below) >= SMALLEST_DISTANCE
        reach = excess / below if met else 1.0
        point[0], point[1], point[2] = (
            focus[0] + reach * x,
            focus[1] + reach * y,
            focus[2] + reach * z,
        )
        if unknown:
            ratio = (height_mean - focus[2]) / max(reach, 1.0)
            elevation = math.asin(min(max(ratio, -STEEPEST), STEEPEST))
    return met


@jit
def closest_point(
    ue: FloatArray,
    bs: FloatArray,
    arrival_azimuth: float,
    arrival_elevation: float,
    departure_azimuth: float,
    departure_elevation: float,
    point: FloatArray,
) -> bool:
    """The midpoint (3,) where the rays of arrival and departure pass closest, both ahead.

    An elevation of NaN counts as 0.
    """
    ux, uy, uz = ray(arrival_azimuth, arrival_elevation)
    wx, wy, wz = ray(departure_azimuth, departure_elevation)
    x, y, z = bs[0] - ue[0], bs[1] - ue[1], bs[2] - ue[2]
    cosine = ux * wx + uy * wy + uz * wz
    sine = 1.0 - cosine * cosine
    if sine < PARALLEL:
        return False
    on_u: float = ux * x + uy * y + uz * z
    on_w: float = wx * x + wy * y + wz * z
    along_u = (on_u - cosine * on_w) / sine
    along_w = (cosine * on_u - on_w) / sine
    point[0] = 0.5 * (ue[0] + along_u * ux + bs[0] + along_w * wx)
    point[1] = 0.5 * (ue[1] + along_u * uy + bs[1] + along_w * wy)
    point[2] = 0.5 * (ue[2] + along_u * uz + bs[2] + along_w * wz)
    return min(along_u, along_w) > 0.0


@jit
def ray(azimuth: float, elevation: float) -> tuple[float, float, float]:
    """Unit vector of a direction [rad]; an elevation of NaN counts as 0."""
    if math.isnan(elevation):
        elevation = 0.0
    ground = math.cos(elevation)
    return ground * math.cos(azimuth), ground * math.sin(azimuth), math.sin(elevation)


@jit
def to_virtual_anchor(ue: FloatArray, ue_height: float, bs: FloatArray, point: FloatArray) -> None:
    """Moves the incidence point (3,) of a path on a wall to the VA behind it."""
    x, y, z = point[0] - ue[0], point[1] - ue[1], point[2] - ue_height
    first = math.sqrt(x * x + y * y + z * z)
    u, v, w = point[0] - bs[0], point[1] - bs[1], point[2] - bs[2]
    ratio = math.sqrt(u * u + v * v + w * w) / max(first, SMALLEST_DISTANCE)
    point[0] += ratio * x
    point[1] += ratio * y
    point[2] += ratio * z
