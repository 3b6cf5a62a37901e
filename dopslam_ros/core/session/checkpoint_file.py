"""Maps and snapshots as bytes: a small container with a version and a checksum.

    8 bytes   ``DOPSTATE``
    uint32    version of the format
    uint32    H, size of the header
    uint64    P, size of the payload
    32 bytes  SHA-256 of all other bytes
    H bytes   header: JSON (with NaN) that names every array, its type and shape
    P bytes   payload: the arrays one after the other, row-major

All little-endian. Nothing is compressed and nothing is executed, so that a file takes as much
memory as it is long, and what does not fit together is refused.
"""

from __future__ import annotations

import hashlib
import json
import math
import struct
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from dopslam_ros.core.linalg.arrays import FloatArray, IntArray
from dopslam_ros.core.models.motion import Control, ControlSpan, Drift
from dopslam_ros.core.pmb import Posterior
from dopslam_ros.core.pmb.density import Density, Undetected
from dopslam_ros.core.pmb.inactive_grid import InactiveGrid, InactiveLandmarks
from dopslam_ros.core.session.checkpoint import Checkpoint, CheckpointError
from dopslam_ros.core.session.checkpoint_checks import check_checkpoint
from dopslam_ros.core.settings.layout import ANGLES, LANDMARK_SIZES, SP, SPACE, VA

Array = FloatArray | IntArray
Buffer = bytes | Array
Arrays = dict[str, Array]

MAGIC = b"DOPSTATE"
VERSION = 1
# 100,000 landmarks.
MOST_BYTES = 1 << 28
MOST_HEADER_BYTES = 1 << 24
_PREFIX = struct.Struct("<8sIIQ")
_START = _PREFIX.size + hashlib.sha256().digest_size
_TYPES: Mapping[str, Any] = {"<f8": np.float64, "<i8": np.int64}
# What is no array, or follows from others.
_KNOWN = ("vehicle", "start", "undetected", "next_id")
# What is an array of its own.
_DENSITY = tuple(n for n in Density._fields if n not in _KNOWN)
_OWN, _ANCHOR = LANDMARK_SIZES[SP], LANDMARK_SIZES[VA]
# Shape of what belongs to one inactive landmark; what is negative is so for each anchor.
_INACTIVE: Mapping[str, tuple[int, ...]] = {
    "track_id": (),
    "existence": (),
    "reactivation_distance": (),
    "position": (SPACE,),
    "origin": (SPACE,),
    "axes": (SPACE, SPACE),
    "q": (_OWN,),
    "covariance": (_OWN, _OWN),
    "anchors": (-1,),
    "anchor_q": (-_ANCHOR,),
    "gain": (_OWN, -_ANCHOR),
    "residual": (_OWN, _OWN),
}
# What has another name in the file, which is older.
_NAMES_IN_FILE = {"reactivation_distance": "reach"}


def encode(saved: Checkpoint) -> list[Buffer]:
    """The pieces of the file, to be written one after the other."""
    arrays = [
        (name, np.ascontiguousarray(array, dtype="<f8" if array.dtype == np.float64 else "<i8"))
        for name, array in _named_arrays(saved)
    ]
    named = [[name, array.dtype.str, list(array.shape)] for name, array in arrays]
    header = {**_about(saved), "arrays": named}
    text = json.dumps(header).encode()
    payload = [array for _, array in arrays if array.size]
    prefix = _PREFIX.pack(MAGIC, VERSION, len(text), sum(p.nbytes for p in payload))
    digest = hashlib.sha256(prefix + text)
    for piece in payload:
        digest.update(piece.data)
    return [prefix, digest.digest(), text, *payload]


def to_bytes(saved: Checkpoint) -> bytes:
    """The whole file."""
    return b"".join(bytes(piece) for piece in encode(saved))


def decode(data: bytes) -> Checkpoint:
    """Reads what ``encode`` has made.

    Raises:
        CheckpointError: it is not such a file, of a newer version, damaged, or makes no sense.
    """
    if data[:8] != MAGIC:
        raise CheckpointError("this is no map or snapshot of dopslam_ros")
    if len(data) < _START:
        raise CheckpointError(f"the file is cut off: it has {len(data)} bytes")
    _, version, header_size, payload_size = _PREFIX.unpack_from(data)
    if version != VERSION:
        raise CheckpointError(
            f"the file has version {version}, this dopslam_ros reads version {VERSION}: read it"
            " with the dopslam_ros that wrote it, or a newer one"
        )
    expected = _START + header_size + payload_size
    if len(data) != expected or header_size > MOST_HEADER_BYTES:
        what = "cut off" if len(data) < expected else "not as it says"
        raise CheckpointError(f"the file is {what}: it has {len(data)} of {expected} bytes")
    content = memoryview(data)
    digest = hashlib.sha256(content[: _PREFIX.size])
    digest.update(content[_START:])
    if digest.digest() != data[_PREFIX.size : _START]:
        raise CheckpointError("the file is damaged: its checksum does not match, use another copy")
    end = _START + header_size
    try:
        header = json.loads(data[_START:end])
        arrays = _arrays(header["arrays"], content[end:])
        saved = _saved(header, arrays)
        if arrays:
            raise CheckpointError(f"the file has arrays of no use: {', '.join(sorted(arrays)[:5])}")
        check_checkpoint(saved)
    except CheckpointError:
        raise
    # A header can be anything: whatever it provokes, it is not one of ours.
    except (KeyError, IndexError, TypeError, ValueError, OverflowError, RecursionError) as error:
        raise CheckpointError(
            f"the file makes no sense: {type(error).__name__}: {error}"
        ) from error
    return saved


def _about(saved: Checkpoint) -> dict[str, Any]:
    """What the header says besides the arrays."""
    return {
        "kind": saved.kind,
        "stamp_ns": saved.stamp_ns,
        "parameters": dict(saved.parameters),
        "known": None if saved.known is None else _about(saved.known),
    }


def _named_arrays(saved: Checkpoint) -> Iterator[tuple[str, Array]]:
    """Every array by name; those of the inactive landmarks flat, one cell after the other."""
    stamps = np.array([stamp for stamp, _ in saved.controls], np.int64)
    values = np.array([list(control) for _, control in saved.controls], np.float64).reshape(-1, 2)
    owed = np.array([[*c, duration, *drift] for c, duration, drift in saved.owed], np.float64)
    yield "control_stamps", stamps
    yield "controls", values
    yield "owed", owed.reshape(-1, 5)
    known = saved.posterior
    yield "weight", known.weight
    for number, hypothesis in enumerate(zip(known.densities, known.inactive, strict=True)):
        for name, array in _of_hypothesis(*hypothesis):
            yield f"{number}/{name}", array
    for name, array in () if saved.known is None else _named_arrays(saved.known):
        yield f"known/{name}", array


def _of_hypothesis(density: Density, inactive: InactiveGrid) -> Iterator[tuple[str, Array]]:
    for name in _DENSITY:
        yield name, getattr(density, name)
    seen = density.undetected
    yield "numbers", np.array([density.next_id, seen.looks], np.int64)
    yield "viewpoints", seen.viewpoints
    yield "viewpoint_looks", seen.viewpoint_looks
    cells = list(inactive.cells.items())
    sizes = [[*index, *cell.anchors.shape] for index, cell in cells]
    yield "cells", np.array(sizes, np.int64).reshape(-1, 4)
    yield "widest", np.array([inactive.largest_distance])
    for name in _INACTIVE if cells else ():
        yield _in_file(name), np.concatenate([getattr(cell, name).ravel() for _, cell in cells])


def _in_file(name: str) -> str:
    """What an array of the inactive landmarks is called in the file."""
    return f"asleep/{_NAMES_IN_FILE.get(name, name)}"


def _saved(about: Any, arrays: Arrays, prefix: str = "") -> Checkpoint:
    """Takes its arrays, whose names begin with ``prefix``, out of all."""

    def take(name: str) -> Any:
        return arrays.pop(prefix + name)

    weight, owed = take("weight"), take("owed").tolist()
    stamps, controls = take("control_stamps").tolist(), take("controls").tolist()
    hypotheses = [_hypothesis(arrays, f"{prefix}{number}/") for number in range(len(weight))]
    if not hypotheses:
        raise CheckpointError("the file has no hypothesis")
    densities, inactive = zip(*hypotheses, strict=True)
    known = about["known"]
    return Checkpoint(
        kind=str(about["kind"]),
        stamp_ns=int(about["stamp_ns"]),
        parameters=dict(about["parameters"]),
        posterior=Posterior(densities, inactive, weight),
        controls=tuple((s, Control(*c)) for s, c in zip(stamps, controls, strict=True)),
        owed=tuple(ControlSpan(Control(v, w), t, Drift(*d)) for v, w, t, *d in owed),
        known=None if known is None else _saved(known, arrays, "known/"),
    )


def _arrays(named: Any, payload: memoryview) -> Arrays:
    """The arrays, in memory of their own; their sizes are those of the file."""
    arrays: Arrays = {}
    start = 0
    for name, kind, shape in named:
        target, size = _TYPES[kind], 8 * math.prod(_whole(length) for length in shape)
        if start + size > len(payload) or name in arrays:
            raise CheckpointError(f"array '{name}' does not fit the file")
        values = np.frombuffer(payload[start : start + size], dtype=kind)
        arrays[str(name)] = values.astype(target).reshape(shape)
        start += size
    if start != len(payload):
        raise CheckpointError(f"the file has {len(payload) - start} bytes of no array")
    return arrays


def _whole(length: Any) -> int:
    if type(length) is not int or not 0 <= length <= MOST_BYTES:
        raise CheckpointError(f"an array has a side of {length!r}")
    return length


def _hypothesis(arrays: Arrays, prefix: str) -> tuple[Density, InactiveGrid]:
    def take(name: str) -> Any:
        return arrays.pop(prefix + name)

    own = {name: take(name) for name in _DENSITY}
    next_id, looks = take("numbers").tolist()
    undetected = Undetected(looks, take("viewpoints"), take("viewpoint_looks"))
    cells, (widest,) = take("cells").tolist(), take("widest").tolist()
    flat = {name: take(_in_file(name)) for name in _INACTIVE} if cells else {}
    sizes = np.array(LANDMARK_SIZES)[own["component_type"]]
    start = np.cumsum([len(ANGLES), *sizes])
    density = Density(**own, vehicle=ANGLES, start=start, undetected=undetected, next_id=next_id)
    return density, InactiveGrid(_cells(cells, flat), widest)


def _cells(
    sizes: list[list[int]], flat: Mapping[str, Any]
) -> dict[tuple[int, int], InactiveLandmarks]:
    """The inactive landmarks of each cell, cut out of the flat arrays of all."""
    cells: dict[tuple[int, int], InactiveLandmarks] = {}
    at = dict.fromkeys(_INACTIVE, 0)
    for x, y, count, anchors in sizes:
        parts: dict[str, Any] = {}
        for name, sides in _INACTIVE.items():
            shape = (count, *(-side * anchors if side < 0 else side for side in sides))
            end = at[name] + math.prod(_whole(side) for side in shape)
            parts[name] = flat[name][at[name] : end].reshape(shape).copy()
            at[name] = end
        cells[x, y] = InactiveLandmarks(**parts)
    if len(cells) != len(sizes) or any(at[name] != flat[name].size for name in flat):
        raise CheckpointError("the cells of the landmarks out of view do not fit together")
    return cells
