"""Compiles the functions of this package and keeps the machine code on disk.

The compiler's own cache knows when a function's file has changed, but not when a function that it
calls has. So the folder of the cache is named after the text of all kernels together.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, cast

import numba

F = TypeVar("F", bound=Callable[..., Any])


def compiled(function: F) -> F:
    """The function as machine code, made at the first call with arguments of new types."""
    return _compiled(function)


def part_of_one(function: F) -> F:
    """A function that only one other calls, and the compiler makes a part of that one.

    What is handed over are dozens of arrays: as functions of their own these take it twice as long.
    """
    return _compiled(function, inline="always")


def _compiled(function: F, **more: Any) -> F:
    # Nobody calls these by a C function's pointer, which takes the compiler long to prepare.
    options: dict[str, Any] = {"error_model": "numpy", "no_cfunc_wrapper": True, **more}
    settings: Any = numba.config
    before, settings.CACHE_DIR = settings.CACHE_DIR, str(cache_folder())
    try:
        return cast(F, numba.njit(cache=True, **options)(function))
    except RuntimeError:  # no folder can be written: compile in every process
        return cast(F, numba.njit(**options)(function))
    finally:
        settings.CACHE_DIR = before


@cache
def cache_folder() -> Path:
    """Where the machine code of these kernels is kept.

    In the user's cache folder, or under NUMBA_CACHE_DIR where that is set.
    """
    digest = hashlib.sha256()
    for source in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(source.read_bytes())
    parent = os.environ.get("NUMBA_CACHE_DIR")
    if not parent:
        home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        parent = str(Path(home) / "dopslam_ros")
    return Path(parent) / f"kernels-{digest.hexdigest()[:16]}"
