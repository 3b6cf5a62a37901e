"""What the vectors are made of: components of vehicle and path, blocks of landmarks.

Kernels read how many there are from the shapes of their arrays; what is named here is where the
ones stand that the models of motion and channel know.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from enum import IntEnum
from typing import NamedTuple, TypeAlias


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


def units(components: Sequence[Component]) -> str:
    """The units of components, as of a parameter that has a number for each."""
    return ", ".join(component.unit for component in components)


def listed(components: Sequence[Component]) -> str:
    """Components in words, a unit after those that have it."""
    groups = itertools.groupby(components, key=lambda component: component.unit)
    return ", ".join(
        ", ".join(one.name.replace("_", " ") for one in group) + f" [{unit}]"
        for unit, group in groups
    )


# The state of the vehicle, s in the paper: moved by the turn-rate model, or walking at random.
TURNS, WALKS = "constant turn rate", "random walk"
VEHICLE = (
    Component("x", "m", motion=TURNS),
    Component("y", "m", motion=TURNS),
    Component("heading", "rad", angle=True, motion=TURNS),
    Component("clock_bias", "m", motion=WALKS),
)
X, Y, HEADING, CLOCK_BIAS = range(len(VEHICLE))

# Which components of a vehicle are angles. The compiler knows the length of a tuple, and so the
# number of components: functions are compiled once for each.
Components: TypeAlias = tuple[bool, ...]
ANGLES: Components = tuple(component.angle for component in VEHICLE)

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
LARGEST_LANDMARK = max(LANDMARK_SIZES)
# Whether all blocks are alike, so that compiled loops over them have a length that is known.
ALIKE = len({size for size in LANDMARK_SIZES if size}) == 1
# Dimensions of a position, whatever else a landmark has.
SPACE = 3

# In the place of an index or an id: no source, no track, no landmark.
NONE = -1
# The id of the base station. Row 0 of the association is its, too.
BS_ID = 0
