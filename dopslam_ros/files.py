"""Files that are whole or not there, and JSON that every reader takes."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path
from typing import Any


def write_whole(path: Path, content: bytes) -> None:
    """Writes a file so that nobody ever finds half of it, whenever the process is killed.

    Raises:
        OSError: it cannot be written.
    """
    part = path.with_name(path.name + ".tmp")
    part.write_bytes(content)
    os.replace(part, path)


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
