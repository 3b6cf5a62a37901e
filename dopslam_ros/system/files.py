"""Files that are whole or not there, and JSON that every reader takes."""

from __future__ import annotations

import errno
import json
import math
import os
import stat
from pathlib import Path
from typing import Any


def write_whole(path: Path, *content: Any, lasting: bool = False) -> None:
    """Writes a file so that nobody ever finds half of it, whenever the process is killed.

    Args:
        path: of the file; one of that name is replaced, a link there is not followed.
        content: bytes, or anything like them, one after the other.
        lasting: also when the machine loses its power.

    Raises:
        OSError: it cannot be written.
    """
    part = path.with_name(path.name + ".tmp")
    part.unlink(missing_ok=True)
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
    try:
        with os.fdopen(os.open(part, flags, 0o666), "wb") as file:
            for piece in content:
                file.write(piece)
            file.flush()
            if lasting:
                os.fsync(file.fileno())
        os.replace(part, path)
    except OSError:
        part.unlink(missing_ok=True)
        raise
    if lasting:
        folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def read_bounded(path: Path, most_bytes: int) -> bytes:
    """Reads an ordinary file that is no link, but not one that would fill the memory.

    Raises:
        OSError: it cannot be read, is something else, or too large.
    """
    flags = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
    with os.fdopen(os.open(path, flags), "rb") as file:
        about = os.fstat(file.fileno())
        if not stat.S_ISREG(about.st_mode):
            raise OSError(errno.EINVAL, "this is no ordinary file", str(path))
        if about.st_size > most_bytes:
            raise OSError(errno.EFBIG, f"more than {most_bytes} bytes", str(path))
        return file.read(most_bytes)


def json_text(content: Any) -> str:
    """JSON has no NaN and no infinity: they become null."""
    return json.dumps(_plain(content), indent=1, allow_nan=False) + "\n"


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
