"""Numbers and texts made safe and small for a page."""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from dopslam_ros.core.linalg.arrays import FloatArray

# What must keep all its digits, and what is whole and may be large.
_DOUBLE = ("time",)


def packed(columns: Mapping[str, FloatArray]) -> dict[str, dict[str, str]]:
    """Columns in base64, in single precision where that is enough for the eye."""
    found = {}
    for name, values in columns.items():
        kind = "f8" if name in _DOUBLE else "i4" if name.endswith(("_start", "_id")) else "f4"
        data = np.ascontiguousarray(values, dtype=f"<{kind}").tobytes()
        found[name] = {"kind": kind, "data": base64.b64encode(data).decode("ascii")}
    return found


def script_json(content: Any) -> str:
    """JSON that may stand in a <script>: nothing in it can end the script or begin a tag."""
    text = json.dumps(content, allow_nan=False, separators=(",", ":"))
    return text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")


def script_digest(script: str) -> str:
    """By which a content security policy lets this script run and no other."""
    digest = hashlib.sha256(script.encode("utf-8")).digest()
    return f"'sha256-{base64.b64encode(digest).decode('ascii')}'"
