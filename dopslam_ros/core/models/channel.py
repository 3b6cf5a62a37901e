"""The channel: what a landmark looks like from the vehicle, h(x, s), and its derivatives.

Every function works on a batch of landmarks at once. The order of the measured components is that
of eq. (3): path length (delay times c), azimuth and elevation of arrival, azimuth and elevation of
departure, Doppler.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dopslam_ros.core.linalg.arrays import (
    BoolArray,
    FloatArray,
    IntArray,
    check_shapes,
    floats,
    integers,
)
from dopslam_ros.core.linalg.vec import SMALLEST_DISTANCE
from dopslam_ros.core.models import channel_kernels as kernels
from dopslam_ros.core.settings.layout import DIM, VEHICLE, LandmarkType


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
    """h(x, s) of eqs. (4)-(12) with the Jacobians A and B of Section III-C.

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

    Raises:
        ValueError: the shapes do not fit together.
    """
    count, size = len(types), max(len(state), len(VEHICLE))
    check_shapes(state=(state, (size,)), positions=(positions, (count, 3)), bs=(bs_position, (3,)))
    paths = Paths(
        np.empty((count, DIM)),
        np.empty((count, DIM, size)),
        np.empty((count, DIM, 3)),
        np.empty(count, dtype=np.bool_),
        np.empty(count, dtype=np.bool_),
    )
    kernels.observe_sources(
        floats(state),
        float(speed),
        floats(bs_position),
        float(ue_height),
        floats(positions),
        integers(types),
        *paths,
    )
    return paths


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
    leg = target - bs_position
    normal = leg / np.maximum(np.linalg.norm(leg, axis=1), SMALLEST_DISTANCE)[:, None]
    along = np.einsum("mi,mi->m", target - ue, normal)
    height = np.einsum("mi,mi->m", 0.5 * (target + bs_position) - ue, normal)
    crosses = (height > SMALLEST_DISTANCE) & (along > height)
    fraction = np.where(crosses, height / np.where(crosses, along, 1.0), np.nan)
    point = ue + fraction[:, None] * (target - ue)
    return np.where((types == LandmarkType.VA)[:, None], point, target)


def residual(measured: FloatArray, expected: FloatArray) -> FloatArray:
    """Innovation z - h (..., 6) with the azimuths wrapped; NaN where nothing was measured."""
    difference = floats(np.subtract(measured, expected))
    kernels.wrap_azimuths(difference.reshape(-1, DIM))
    return difference
