"""h(x, s) of eqs. (4)-(12), A = dh/ds and B = dh/dx, for one landmark and for many."""

from __future__ import annotations

import math
from typing import NamedTuple

from dopslam_ros.core.linalg.arrays import BoolArray, FloatArray, IntArray
from dopslam_ros.core.linalg.jit import from_python, jit
from dopslam_ros.core.linalg.vec import (
    SMALLEST_DISTANCE,
    Vec,
    between,
    dot,
    horizontal,
    scaled,
    unit,
    vec,
)
from dopslam_ros.core.settings.layout import (
    AOA_AZIMUTH,
    AOA_ELEVATION,
    AOD_AZIMUTH,
    AOD_ELEVATION,
    BS,
    CLOCK_BIAS,
    DIM,
    DOPPLER,
    HEADING,
    SP,
    TOA,
    VA,
    X,
    Y,
)


class Legs(NamedTuple):
    """The geometry of a path.

    Attributes:
        distance: from the vehicle to the landmark [m].
        arrival: unit vector along it, u.
        leg: from the BS to the landmark, or to the vehicle for the BS itself [m].
        outward: unit vector along it, n; of a VA the normal of its wall.
        departure: unit vector in which the path leaves the BS, w.
    """

    distance: float
    arrival: Vec
    leg: float
    outward: Vec
    departure: Vec


@jit
def legs_of(vehicle: Vec, bs: Vec, landmark: Vec, kind: int) -> Legs:
    """The geometry of the path over a landmark of some type, with its directions, eqs. (5) and (8).

    The landmark of the BS is the BS itself.
    """
    distance, arrival = unit(between(vehicle, landmark))
    leg, outward = unit(between(bs, vehicle if kind == BS else landmark))
    departure = outward
    if kind == VA:  # the arrival mirrored at the wall
        departure = mirrored(arrival, outward)
    return Legs(distance, arrival, leg, outward, departure)


@jit
def mirrored(u: Vec, n: Vec) -> Vec:
    """-(I - 2 n n') u: the other way along u, mirrored at the plane with the normal n."""
    along = scaled(2.0 * dot(n, u), n)
    return Vec(along.x - u.x, along.y - u.y, along.z - u.z)


@jit
def toa(legs: Legs, clock_bias: float, kind: int) -> float:
    """Length of the path and clock bias [m], eq. (4); that of a VA is its distance."""
    return legs.distance + clock_bias + (legs.leg if kind == SP else 0.0)


@jit
def azimuth(direction: Vec) -> float:
    """Of a direction [rad], counter-clockwise from x: eqs. (6) and (9), less the heading in (6)."""
    return math.atan2(direction.y, direction.x)


@jit
def elevation(direction: Vec) -> float:
    """Of a direction [rad], positive up: eqs. (7) and (10)."""
    return math.atan2(direction.z, horizontal(direction))


@jit
def doppler(velocity: Vec, arrival: Vec) -> float:
    """Velocity towards where the path comes from [m/s], eq. (11)."""
    return arrival.x * velocity.x + arrival.y * velocity.y


@jit
def observe_source(
    ue: FloatArray,
    speed: float,
    bs: FloatArray,
    ue_height: float,
    position: FloatArray,
    kind: int,
    h: FloatArray,
    a: FloatArray,
    b: FloatArray,
) -> tuple[bool, bool]:
    """h(x, s) of eqs. (4)-(12) with A = dh/ds and B = dh/dx, for one landmark.

    Args:
        ue: (U,) components of the vehicle (``layout.VEHICLE``).
        speed: v [m/s].
        bs: (3,) position of the base station [m].
        ue_height: z of the vehicle's antenna [m].
        position: (3,) of the landmark [m]; ignored for the BS.
        kind: LandmarkType.
        h: (6,) to be written.
        a: (6, U) to be written.
        b: (6, 3) to be written; zero for the BS.

    Returns:
        Whether the geometry is degenerate (h is then finite but means nothing, A and B are zero)
        and whether the path can exist; see ``channel.Paths``.
    """
    vehicle, station = Vec(ue[X], ue[Y], ue_height), vec(bs)
    landmark = station if kind == BS else vec(position)
    velocity = Vec(speed * math.cos(ue[HEADING]), speed * math.sin(ue[HEADING]), 0.0)
    legs = legs_of(vehicle, station, landmark, kind)
    h[TOA] = toa(legs, ue[CLOCK_BIAS], kind)
    h[AOA_AZIMUTH] = wrapped(azimuth(legs.arrival) - ue[HEADING])
    h[AOA_ELEVATION] = elevation(legs.arrival)
    h[AOD_AZIMUTH] = azimuth(legs.departure)
    h[AOD_ELEVATION] = elevation(legs.departure)
    h[DOPPLER] = doppler(velocity, legs.arrival)
    clear(a, b)
    beneath, ground = horizontal(between(vehicle, landmark)), horizontal(legs.departure)
    if min(legs.distance, legs.leg, beneath, ground) < SMALLEST_DISTANCE:
        return True, False
    differentiate(legs, velocity, h[DOPPLER], kind, a, b)
    return False, kind != VA or before_the_wall(vehicle, station, landmark, legs.outward)


@jit
def before_the_wall(vehicle: Vec, bs: Vec, va: Vec, normal: Vec) -> bool:
    """Whether the vehicle is on that side of a wall on which the BS is."""
    beyond = normal.x * (vehicle.x - 0.5 * (va.x + bs.x))
    beyond += normal.y * (vehicle.y - 0.5 * (va.y + bs.y))
    beyond += normal.z * (vehicle.z - 0.5 * (va.z + bs.z))
    return beyond < -SMALLEST_DISTANCE


@from_python
def observe_sources(
    ue: FloatArray,
    speed: float,
    bs: FloatArray,
    ue_height: float,
    positions: FloatArray,
    types: IntArray,
    mean: FloatArray,
    ue_jacobian: FloatArray,
    landmark_jacobian: FloatArray,
    degenerate: BoolArray,
    facing: BoolArray,
) -> None:
    """``observe_source`` for M landmarks: positions (M, 3), types (M,); the rest is written.

    mean (M, 6), ue_jacobian (M, 6, U), landmark_jacobian (M, 6, 3), degenerate (M,), facing (M,).
    """
    for m in range(len(types)):
        degenerate[m], facing[m] = observe_source(
            ue,
            speed,
            bs,
            ue_height,
            positions[m],
            types[m],
            mean[m],
            ue_jacobian[m],
            landmark_jacobian[m],
        )


@jit
def clear(a: FloatArray, b: FloatArray) -> None:
    """Sets A (6, U) and B (6, 3) to zero."""
    for row in range(DIM):
        for k in range(a.shape[1]):
            a[row, k] = 0.0
        b[row, 0] = b[row, 1] = b[row, 2] = 0.0


@jit
def wrapped(angle: float) -> float:
    """An angle [rad] brought into (-pi, pi]; NaN stays NaN."""
    return math.pi - (math.pi - angle) % (2.0 * math.pi)


@from_python
def wrap_azimuths(differences: FloatArray) -> None:
    """Wraps the azimuths among innovations (M, 6)."""
    for m in range(len(differences)):
        differences[m, AOA_AZIMUTH] = wrapped(differences[m, AOA_AZIMUTH])
        differences[m, AOD_AZIMUTH] = wrapped(differences[m, AOD_AZIMUTH])


@jit
def azimuth_gradient(direction: Vec, distance: float) -> Vec:
    """Derivative of an azimuth by the far end of a line of some length [m] along a direction."""
    ground = horizontal(direction)
    scale = ground * ground * distance
    return Vec(-direction.y / scale, direction.x / scale, 0.0)


@jit
def elevation_gradient(direction: Vec, distance: float) -> Vec:
    """Derivative of an elevation by the far end of a line of some length [m] along a direction."""
    ground = horizontal(direction)
    scale = ground * distance
    x, y = -direction.z * direction.x / scale, -direction.z * direction.y / scale
    return Vec(x, y, ground / distance)


@jit
def put(gradient: Vec, jacobian: FloatArray, row: int) -> None:
    """Writes a gradient by a position into a row of B (6, 3)."""
    jacobian[row, 0], jacobian[row, 1], jacobian[row, 2] = gradient.x, gradient.y, gradient.z


@jit
def differentiate(
    legs: Legs, velocity: Vec, speed_along: float, kind: int, a: FloatArray, b: FloatArray
) -> None:
    """A and B of eq. (19), which are zero so far.

    Args:
        legs: of a path that is not degenerate.
        velocity: v [m/s].
        speed_along: its Doppler [m/s].
        kind: LandmarkType.
        a: (6, U) to be written.
        b: (6, 3) to be written.
    """
    differentiate_arrival(legs, velocity, speed_along, a, b)
    if kind == VA:
        differentiate_mirrored(legs, a, b)
    elif kind == SP:
        b[TOA, 0] += legs.outward.x
        b[TOA, 1] += legs.outward.y
        b[TOA, 2] += legs.outward.z
        put(azimuth_gradient(legs.outward, legs.leg), b, AOD_AZIMUTH)
        put(elevation_gradient(legs.outward, legs.leg), b, AOD_ELEVATION)
    else:  # the BS does not move; its line ends at the vehicle
        for row in range(DIM):
            b[row, 0] = b[row, 1] = b[row, 2] = 0.0
        by_vehicle = azimuth_gradient(legs.outward, legs.leg)
        a[AOD_AZIMUTH, X], a[AOD_AZIMUTH, Y] = by_vehicle.x, by_vehicle.y
        by_vehicle = elevation_gradient(legs.outward, legs.leg)
        a[AOD_ELEVATION, X], a[AOD_ELEVATION, Y] = by_vehicle.x, by_vehicle.y


@jit
def differentiate_arrival(
    legs: Legs, velocity: Vec, speed_along: float, a: FloatArray, b: FloatArray
) -> None:
    """Rows of A and B for the distance to the landmark, the arrival along u, and the Doppler.

    Those of the Doppler are a and b of eqs. (20), (21), as eqs. (24), (25) expand them:
    d(v'u)/dx = (v - (v'u) u) / distance; the vehicle moves h as the landmark does, the other way.
    """
    u, distance = legs.arrival, legs.distance
    put(u, b, TOA)
    put(azimuth_gradient(u, distance), b, AOA_AZIMUTH)
    put(elevation_gradient(u, distance), b, AOA_ELEVATION)
    b[DOPPLER, 0] = (velocity.x - speed_along * u.x) / distance
    b[DOPPLER, 1] = (velocity.y - speed_along * u.y) / distance
    b[DOPPLER, 2] = -speed_along * u.z / distance
    for row in range(DIM):  # those of the departure are zero so far
        a[row, X], a[row, Y] = -b[row, 0], -b[row, 1]
    a[TOA, CLOCK_BIAS] = 1.0
    a[AOA_AZIMUTH, HEADING] = -1.0
    a[DOPPLER, HEADING] = u.y * velocity.x - u.x * velocity.y


@jit
def differentiate_mirrored(legs: Legs, a: FloatArray, b: FloatArray) -> None:
    """Rows of A and B for the departure w = -(I - 2 n n') u of a VA.

    With r the gradient of an angle by w: r dw = (I - 2 n n') r du for the vehicle and the VA, and
    for the VA, which turns the wall, 2 ((n u) r + (r n) u - 2 (n u) (r n) n) / leg on top.
    """
    differentiate_mirrored_angle(legs, azimuth_gradient(legs.departure, 1.0), AOD_AZIMUTH, a, b)
    differentiate_mirrored_angle(legs, elevation_gradient(legs.departure, 1.0), AOD_ELEVATION, a, b)


@jit
def differentiate_mirrored_angle(
    legs: Legs, r: Vec, row: int, a: FloatArray, b: FloatArray
) -> None:
    """The row of one of the angles of w, r being its gradient by w."""
    u, n, distance, leg = legs.arrival, legs.outward, legs.distance, legs.leg
    along, across = dot(n, u), 2.0 * (r.x * n.x + r.y * n.y + r.z * n.z)
    m = Vec(r.x - across * n.x, r.y - across * n.y, r.z - across * n.z)
    a[row, X], a[row, Y] = m.x / distance, m.y / distance
    # (n u) (r - 2 (r n) n) = (n u) m
    b[row, 0] = (2.0 * along * m.x + across * u.x) / leg - m.x / distance
    b[row, 1] = (2.0 * along * m.y + across * u.y) / leg - m.y / distance
    b[row, 2] = (2.0 * along * m.z + across * u.z) / leg - m.z / distance
