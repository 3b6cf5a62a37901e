"""h(x, s) and its derivatives, for one landmark and for many."""

from __future__ import annotations

import math

from dopslam_ros.core.linalg.arrays import BoolArray, FloatArray, IntArray
from dopslam_ros.core.linalg.jit import from_python, jit
from dopslam_ros.core.settings.layout import BS, DIM, SP, VA

# Two points closer than this [m] have no direction from one to the other.
SMALLEST_DISTANCE = 1e-6


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
    """h(x, s) of eqs. (4)-(11) with A = dh/ds and B = dh/dx, for one landmark.

    Args:
        ue: (4,) x [m], y [m], heading [rad], clock bias [m].
        speed: v [m/s].
        bs: (3,) position of the base station [m].
        ue_height: z of the vehicle's antenna [m].
        position: (3,) of the landmark [m]; ignored for the BS.
        kind: LandmarkType.
        h: (6,) to be written.
        a: (6, 4) to be written.
        b: (6, 3) to be written; zero for the BS.

    Returns:
        Whether the geometry is degenerate (h is then finite but means nothing, A and B are zero)
        and whether the path can exist; see ``channel.Paths``.
    """
    px, py, pz = position[0], position[1], position[2]
    if kind == BS:
        px, py, pz = bs[0], bs[1], bs[2]
    dx, dy, dz = px - ue[0], py - ue[1], pz - ue_height
    distance, ux, uy, uz = unit(dx, dy, dz)
    # The leg from the BS: to the vehicle for the BS itself, else to the landmark.
    if kind == BS:
        leg, nx, ny, nz = unit(-dx, -dy, -dz)
    else:
        leg, nx, ny, nz = unit(px - bs[0], py - bs[1], pz - bs[2])
    along = nx * ux + ny * uy + nz * uz
    wx, wy, wz = nx, ny, nz
    if kind == VA:  # n is the normal of the wall, the departure the arrival mirrored at it
        wx, wy, wz = 2.0 * along * nx - ux, 2.0 * along * ny - uy, 2.0 * along * nz - uz

    ground = math.sqrt(wx * wx + wy * wy)
    cosine, sine = speed * math.cos(ue[2]), speed * math.sin(ue[2])
    h[0] = distance + ue[3] + (leg if kind == SP else 0.0)
    h[1] = wrapped(math.atan2(uy, ux) - ue[2])
    h[2] = math.atan2(uz, math.sqrt(ux * ux + uy * uy))
    h[3] = math.atan2(wy, wx)
    h[4] = math.atan2(wz, ground)
    h[5] = ux * cosine + uy * sine
    clear(a, b)
    beneath = math.sqrt(dx * dx + dy * dy)
    if min(distance, leg, beneath, ground) < SMALLEST_DISTANCE:
        return True, False

    arrival_rows(ux, uy, uz, distance, cosine, sine, h[5], a, b)
    if kind == VA:
        mirrored_rows(ux, uy, uz, distance, nx, ny, nz, leg, a, b)
        beyond = nx * (ue[0] - 0.5 * (px + bs[0])) + ny * (ue[1] - 0.5 * (py + bs[1]))
        beyond += nz * (ue_height - 0.5 * (pz + bs[2]))
        # The signed distance of the vehicle from the wall, the BS being at the negative side.
        return False, beyond < -SMALLEST_DISTANCE
    if kind == SP:
        b[0, 0] += nx
        b[0, 1] += ny
        b[0, 2] += nz
        angle_rows(nx, ny, nz, leg, b, 3)
        return False, True
    for row in range(DIM):
        b[row, 0] = b[row, 1] = b[row, 2] = 0.0
    angle_rows(nx, ny, nz, leg, a, 3)
    return False, True


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

    mean (M, 6), ue_jacobian (M, 6, 4), landmark_jacobian (M, 6, 3), degenerate (M,), facing (M,).
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
    """Sets A (6, 4) and B (6, 3) to zero."""
    for row in range(DIM):
        a[row, 0] = a[row, 1] = a[row, 2] = a[row, 3] = 0.0
        b[row, 0] = b[row, 1] = b[row, 2] = 0.0


@jit
def unit(x: float, y: float, z: float) -> tuple[float, float, float, float]:
    """Length of a vector, then its unit vector; one of no length points along x."""
    length = math.sqrt(x * x + y * y + z * z)
    if length < SMALLEST_DISTANCE:
        return length, 1.0, 0.0, 0.0
    return length, x / length, y / length, z / length


@jit
def wrapped(angle: float) -> float:
    """An angle [rad] brought into (-pi, pi]; NaN stays NaN."""
    return math.pi - (math.pi - angle) % (2.0 * math.pi)


@from_python
def wrap_azimuths(differences: FloatArray) -> None:
    """Wraps the azimuths among innovations (M, 6)."""
    for m in range(len(differences)):
        differences[m, 1] = wrapped(differences[m, 1])
        differences[m, 3] = wrapped(differences[m, 3])


@jit
def angle_rows(
    x: float, y: float, z: float, distance: float, jacobian: FloatArray, row: int
) -> None:
    """Derivatives of azimuth and elevation by the far end of a line.

    Args:
        x: of the unit vector along the line, not upright.
        y: of it.
        z: of it.
        distance: length of the line [m].
        jacobian: (6, 3) by a landmark, or (6, 4) by the vehicle, of which x and y are written.
        row: of the azimuth; that of the elevation comes next.
    """
    ground = math.sqrt(x * x + y * y)
    jacobian[row, 0] = -y / (ground * ground * distance)
    jacobian[row, 1] = x / (ground * ground * distance)
    jacobian[row + 1, 0] = -z * x / (ground * distance)
    jacobian[row + 1, 1] = -z * y / (ground * distance)
    if jacobian.shape[1] == 3:
        jacobian[row + 1, 2] = ground / distance


@jit
def arrival_rows(
    x: float,
    y: float,
    z: float,
    distance: float,
    cosine: float,
    sine: float,
    doppler: float,
    a: FloatArray,
    b: FloatArray,
) -> None:
    """Rows of A and B for the distance, the arrival along (x, y, z) and the Doppler.

    Args:
        x: of the unit vector of arrival.
        y: of it.
        z: of it.
        distance: to the landmark [m].
        cosine: v cos(heading) [m/s].
        sine: v sin(heading) [m/s].
        doppler: [m/s].
        a: (6, 4) to be written.
        b: (6, 3) to be written.
    """
    b[0, 0], b[0, 1], b[0, 2] = x, y, z
    angle_rows(x, y, z, distance, b, 1)
    b[5, 0] = (cosine - doppler * x) / distance
    b[5, 1] = (sine - doppler * y) / distance
    b[5, 2] = -doppler * z / distance
    for row in range(DIM):  # those of the departure are zero so far
        a[row, 0], a[row, 1] = -b[row, 0], -b[row, 1]
    a[0, 3] = 1.0
    a[1, 2] = -1.0
    a[5, 2] = y * cosine - x * sine


@jit
def mirrored_rows(
    ux: float,
    uy: float,
    uz: float,
    distance: float,
    nx: float,
    ny: float,
    nz: float,
    leg: float,
    a: FloatArray,
    b: FloatArray,
) -> None:
    """Rows of A and B for the departure w = -(I - 2 n n') u of a VA.

    With r the gradient of an angle by w: r dw = (I - 2 n n') r du for the vehicle and the VA, and
    for the VA, which turns the wall, 2 ((n u) r + (r n) u - 2 (n u) (r n) n) / leg on top.

    Args:
        ux: of the unit vector of arrival.
        uy: of it.
        uz: of it.
        distance: to the VA [m].
        nx: of the wall's normal.
        ny: of it.
        nz: of it.
        leg: from BS to VA [m].
        a: (6, 4) to be written.
        b: (6, 3) to be written.
    """
    along = nx * ux + ny * uy + nz * uz
    wx, wy, wz = 2.0 * along * nx - ux, 2.0 * along * ny - uy, 2.0 * along * nz - uz
    angle_rows(wx, wy, wz, 1.0, b, 3)
    for row in range(3, 5):
        rx, ry, rz = b[row, 0], b[row, 1], b[row, 2]
        across = 2.0 * (rx * nx + ry * ny + rz * nz)
        mx, my, mz = rx - across * nx, ry - across * ny, rz - across * nz
        a[row, 0], a[row, 1] = mx / distance, my / distance
        # (n u) (r - 2 (r n) n) = (n u) m
        b[row, 0] = (2.0 * along * mx + across * ux) / leg - mx / distance
        b[row, 1] = (2.0 * along * my + across * uy) / leg - my / distance
        b[row, 2] = (2.0 * along * mz + across * uz) / leg - mz / distance
