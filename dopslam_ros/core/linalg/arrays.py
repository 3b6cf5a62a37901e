"""Small array helpers that every module of the core shares."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

FloatArray: TypeAlias = npt.NDArray[np.float64]
IntArray: TypeAlias = npt.NDArray[np.int64]
BoolArray: TypeAlias = npt.NDArray[np.bool_]


def floats(values: FloatArray) -> FloatArray:
    """Numbers as the compiled functions take them; a copy only where they are not so already."""
    ready = np.ascontiguousarray(values, dtype=np.float64)
    return ready if ready.flags.writeable else ready.copy()


def integers(values: IntArray) -> IntArray:
    """The same for integers."""
    ready = np.ascontiguousarray(values, dtype=np.int64)
    return ready if ready.flags.writeable else ready.copy()


def check_shapes(**arrays: tuple[npt.NDArray[Any], tuple[int, ...]]) -> None:
    """Compiled functions look at no bounds, so what enters them from outside is checked.

    Args:
        arrays: by name, an array and the shape it must have.

    Raises:
        ValueError: one has another shape.
    """
    for name, (array, shape) in arrays.items():
        if array.shape != shape:
            raise ValueError(f"'{name}' has the shape {array.shape}, it must have {shape}")


def wrap_angle(angle: FloatArray) -> FloatArray:
    """Angles [rad] brought into (-pi, pi]; NaN stays NaN."""
    wrapped = np.asarray(np.pi - np.mod(np.pi - angle, 2.0 * np.pi), dtype=np.float64)
    return wrapped


def symmetrise(matrix: FloatArray) -> FloatArray:
    """The symmetric part of a stack of matrices (..., n, n)."""
    return 0.5 * (matrix + np.swapaxes(matrix, -1, -2))
