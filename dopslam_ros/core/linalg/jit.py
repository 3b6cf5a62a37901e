"""Compiles the functions of this package and keeps the machine code on disk.

The compiler's own cache knows when a function's file has changed, but not when a function that it
calls has. So the folder of the cache is named after the text of all of the core.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
import numpy as np

if os.environ.get("NUMBA_DISABLE_JIT", "0") not in ("", "0"):
    # Plain Python then, as debuggers want it: compiled code divides by zero without a warning, too.
    np.seterr(all="ignore")

F = TypeVar("F", bound=Callable[..., Any])
# Nobody calls these by a C function's pointer, which takes the compiler long to prepare.
_njit: Any = partial(numba.njit, error_model="numpy", no_cfunc_wrapper=True)


def from_python(function: F) -> F:
    """The function as machine code that Python may call, made at the first call with new types.

    Args:
        function: plain, or one of ``jit``, which gets a way in from Python beside what it is.
    """
    plain = getattr(function, "py_func", function)
    settings: Any = numba.config
    before, settings.CACHE_DIR = settings.CACHE_DIR, str(cache_folder())
    try:
        return cast(F, _njit(cache=True)(plain))
    except RuntimeError:  # no folder can be written: compile in every process
        return cast(F, _njit()(plain))
    finally:
        settings.CACHE_DIR = before


def jit(function: F) -> F:
    """A function that only compiled ones may call: Python has no way in, and would crash.

    Half of the machine code of a function of many arrays is that way in; ``from_python`` makes it.
    """
    return cast(F, _njit(no_cpython_wrapper=True)(function))


def jit_inline(function: F) -> F:
    """A ``jit`` function that only one other calls, and the compiler makes it a piece of that one.

    What is handed over are dozens of arrays: as functions of their own these take it twice as long.
    """
    return cast(F, _njit(no_cpython_wrapper=True, inline="always")(function))


def kernel_sources() -> list[Path]:
    """The files of the core: compiled functions, and the constants and records they are made of."""
    return sorted(Path(__file__).parents[1].rglob("*.py"))


@cache
def cache_folder() -> Path:
    """Where the machine code of these kernels is kept.

    In the user's cache folder, or under NUMBA_CACHE_DIR where that is set.
    """
    digest = hashlib.sha256()
    for source in kernel_sources():
        digest.update(source.read_bytes())
    parent = os.environ.get("NUMBA_CACHE_DIR")
    if not parent:
        home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        parent = str(Path(home) / "dopslam_ros")
    return Path(parent) / f"kernels-{digest.hexdigest()[:16]}"
