"""Vectors in space, as three numbers that cost nothing to hand on."""

from __future__ import annotations

import math
from typing import NamedTuple

from dopslam_ros.core.linalg.arrays import FloatArray
from dopslam_ros.core.linalg.jit import jit

# Two points closer than this [m] have no direction from one to the other.
SMALLEST_DISTANCE = 1e-6


class Vec(NamedTuple):
    """A position [m], or a direction."""

    x: float
    y: float
    z: float


@jit
def vec(values: FloatArray) -> Vec:
    """The vector of three numbers in an array (3,)."""
    return Vec(values[0], values[1], values[2])


@jit
def write(v: Vec, values: FloatArray) -> None:
    """Writes a vector into an array (3,)."""
    values[0], values[1], values[2] = v.x, v.y, v.z


@jit
def write_row(v: Vec, rows: FloatArray, row: int) -> None:
    """Writes a vector into a row of an array (n, 3)."""
    rows[row, 0], rows[row, 1], rows[row, 2] = v.x, v.y, v.z


@jit
def between(start: Vec, end: Vec) -> Vec:
    """From one position to another."""
    return Vec(end.x - start.x, end.y - start.y, end.z - start.z)


@jit
def distance_between(a: Vec, b: Vec) -> float:
    """How far two positions are from each other."""
    x, y, z = between(a, b)
    return math.sqrt(x * x + y * y + z * z)


@jit
def moved(start: Vec, factor: float, v: Vec) -> Vec:
    """A position, so many times a vector further."""
    return Vec(start.x + factor * v.x, start.y + factor * v.y, start.z + factor * v.z)


@jit
def scaled(factor: float, v: Vec) -> Vec:
    """A multiple of a vector."""
    return Vec(factor * v.x, factor * v.y, factor * v.z)


@jit
def dot(a: Vec, b: Vec) -> float:
    """The inner product."""
    return a.x * b.x + a.y * b.y + a.z * b.z


@jit
def cross(a: Vec, b: Vec) -> Vec:
    """The outer product."""
    return Vec(a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x)


@jit
def unit(v: Vec) -> tuple[float, Vec]:
    """Length of a vector, then its unit vector; one of no length points along x."""
    length = math.sqrt(v.x * v.x + v.y * v.y + v.z * v.z)
    if length < SMALLEST_DISTANCE:
        return length, Vec(1.0, 0.0, 0.0)
    return length, Vec(v.x / length, v.y / length, v.z / length)


@jit
def horizontal(v: Vec) -> float:
    """Length of what of a vector is horizontal."""
    return math.sqrt(v.x * v.x + v.y * v.y)
