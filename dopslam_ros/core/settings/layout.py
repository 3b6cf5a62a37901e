"""What the vectors are made of: components of vehicle and path, blocks of landmarks.

Kernels read how many there are from the shapes of their arrays; what is named here is where the
ones stand that the models of motion and channel know.
"""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple


class Component(NamedTuple):
    """One number of a state or of a path.

    Attributes:
        name: as in messages and parameters.
        unit: SI.
        angle: whether differences of it are wrapped into (-pi, pi].
        motion: how it moves between snapshots; "" where it is no part of a state.
    """

    name: str
    unit: str
    angle: bool = False
    motion: str = ""


# The state of the vehicle, s in the paper: moved by the turn-rate model, or walking at random.
TURNS, WALKS = "constant turn rate", "random walk"
VEHICLE = (
    Component("x", "m", motion=TURNS),
    Component("y", "m", motion=TURNS),
    Component("heading", "rad", angle=True, motion=TURNS),
    Component("clock_bias", "m", motion=WALKS),
)
X, Y, HEADING, CLOCK_BIAS = range(4)
UE = len(VEHICLE)

# What is measured of a path, z in eq. (3).
PATH = (
    Component("path_length", "m"),
    Component("aoa_azimuth", "rad", angle=True),
    Component("aoa_elevation", "rad"),
    Component("aod_azimuth", "rad", angle=True),
    Component("aod_elevation", "rad"),
    Component("doppler", "m/s"),
)
COMPONENTS = tuple(component.name for component in PATH)
DIM = len(PATH)
TOA, AOA_AZIMUTH, AOA_ELEVATION, AOD_AZIMUTH, AOD_ELEVATION, DOPPLER = range(DIM)
AZIMUTHS = (AOA_AZIMUTH, AOD_AZIMUTH)

BS, VA, SP = 0, 1, 2


class LandmarkType(IntEnum):
    """m in the paper. The numbers are those of dopslam_msgs/Landmark."""

    BS = BS
    VA = VA
    SP = SP


# The types that a landmark of unknown type may have; a BS is always known.
UNKNOWN_TYPES = (VA, SP)
# How many numbers the block of a landmark has in the joint vector, by its type.
LANDMARK_SIZES = (0, 3, 3)

# In the place of an index or an id: no source, no track, no landmark.
NONE = -1
# The id of the base station. Row 0 of the association is its, too.
BS_ID = 0
# The dimension of space: of positions, directions and the axes of frames.
SPACE = 3
