"""Message types without ROS: definitions, hashes and serialisation.

The common types of Jazzy come with the ``rosbags`` library; those of ``dopslam_msgs`` are read from
their .msg files, wherever these are installed.
"""

from __future__ import annotations

import json
import os
import re
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import cast

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from dopslam_ros.bag import cdr
from dopslam_ros.bag.errors import BagTypeError

PACKAGE = "dopslam_msgs"

_SOURCE_TREE = Path(__file__).resolve().parents[2] / "msg_defs" / "msg"
_ENCAPSULATION = b"\0\1\0\0"  # CDR, little-endian
_SEPARATOR = "=" * 80
_TYPE_NAME = re.compile(r"(\w+)/(?:msg/)?(\w+)")
_FIELD_TYPE = re.compile(r"^[ \t]*([A-Za-z]\w*(?:/\w+)*)(?:<=\d+)?(?:\[[^\]]*\])?[ \t]+\w", re.M)
_PRIMITIVE = re.compile(r"bool|byte|char|w?string|float(32|64)|u?int(8|16|32|64)")


@cache
def typestore() -> Typestore:
    """Types of ROS 2 Jazzy and of ``dopslam_msgs``.

    Raises:
        BagTypeError: The .msg files of ``dopslam_msgs`` are nowhere to be found.
    """
    store = get_typestore(Stores.ROS2_JAZZY)
    for path in sorted(_own_definitions().glob("*.msg")):
        store.register(get_types_from_msg(path.read_text("utf-8"), f"{PACKAGE}/msg/{path.stem}"))
    return store


@cache
def message_class(type_name: str) -> type[object]:
    """Class whose objects ``serialize`` takes and ``deserialize`` gives.

    Args:
        type_name: Such as ``nav_msgs/msg/Odometry``.

    Raises:
        BagTypeError: The type is unknown.
    """
    try:
        return cast("type[object]", typestore().types[type_name])
    except KeyError:
        raise _unknown(type_name) from None


def serialize(message: object, type_name: str) -> bytes:
    """Serialise a message in CDR, little-endian, as the middleware sends it.

    Gaps are zero and the end is padded to a multiple of four bytes, as the wire protocol (RTPS)
    does: a subscriber that takes raw bytes gets exactly these.

    Args:
        message: Object of ``message_class(type_name)``. A list of messages of fixed size in it may
            be an array of ``record_type`` instead.
        type_name: Such as ``nav_msgs/msg/Odometry``.

    Raises:
        BagTypeError: The type is unknown or the message does not fit it.
    """
    message_class(type_name)
    content = bytearray()
    try:
        cdr.encoder(typestore(), type_name)(message, content)
    except Exception as error:  # whatever the field's value provokes
        raise BagTypeError(f"this message is no {type_name}: {error!r}") from error
    return _ENCAPSULATION + content + bytes(-len(content) % 4)


def record_type(type_name: str) -> np.dtype[np.void]:
    """Structured type of the arrays that ``serialize`` takes in the place of lists of messages.

    Args:
        type_name: A type of fixed size, such as ``dopslam_msgs/msg/Landmark``.

    Raises:
        BagTypeError: The type is unknown or has no fixed size.
    """
    message_class(type_name)
    try:
        return cdr.record_type(typestore(), type_name)
    except ValueError as error:
        raise BagTypeError(str(error)) from error


def deserialize(payload: bytes, type_name: str) -> object:
    """Read a message from CDR.

    Args:
        payload: Bytes as recorded, encapsulation header included.
        type_name: Such as ``nav_msgs/msg/Odometry``.

    Returns:
        Object of ``message_class(type_name)``.

    Raises:
        BagTypeError: The type is unknown or the bytes are none of it.
    """
    message_class(type_name)
    try:
        return typestore().deserialize_cdr(payload, type_name)
    except Exception as error:  # the library raises whatever the bytes provoke
        raise BagTypeError(f"{len(payload)} bytes are no {type_name}: {error!r}") from error


def canonical(payload: bytes, type_name: str) -> bytes:
    """Serialise a message again, with zeros in the gaps between its fields.

    The middleware leaves in these gaps whatever the memory contained: two serialisations of equal
    messages need not be equal. Those of this package are.

    Args:
        payload: The message in CDR, from whatever source.
        type_name: Such as ``nav_msgs/msg/Odometry``.

    Raises:
        BagTypeError: The type is unknown or the bytes are none of it.
    """
    return serialize(deserialize(payload, type_name), type_name)


@cache
def type_hash(type_name: str) -> str:
    """Hash of a type (``RIHS01_...``, REP-2011), as discovery reports it.

    Args:
        type_name: Such as ``nav_msgs/msg/Odometry``, or one of any package that is installed.

    Raises:
        BagTypeError: The type is unknown.
    """
    if type_name in typestore().types:
        return str(typestore().hash_rihs01(type_name))
    return _installed_hash(type_name)


@cache
def definition(type_name: str) -> str:
    """Definition of a type and of all types in it, as rosbag2 stores it.

    The texts are those of the installed .msg files, comments included. Of a package of Jazzy that
    is not installed the definitions are made from the type store, without comments.

    Args:
        type_name: Such as ``nav_msgs/msg/Odometry``.

    Returns:
        The type's own text, then each nested type's after a line of 80 ``=`` and one of
        ``MSG: package/Name``.

    Raises:
        BagTypeError: The type, or one in it, is unknown.
    """
    return _with_nested(type_name, set())


def _installed_hash(type_name: str) -> str:
    """Hash that the build of the type's package has left beside the definition."""
    package, name = _split(type_name)
    for folder in _definition_folders(package):
        path = folder / f"{name}.json"
        if path.is_file():
            hashes = json.loads(path.read_bytes())["type_hashes"]
            return str(next(h["hash_string"] for h in hashes if h["type_name"] == type_name))
    raise _unknown(type_name)


def _split(type_name: str) -> tuple[str, str]:
    """Package and name of a type."""
    match = _TYPE_NAME.fullmatch(type_name)
    if match is None:
        raise BagTypeError(f"{type_name!r} is no message type: write it as 'package/msg/Name'")
    return match[1], match[2]


def _with_nested(type_name: str, seen: set[str]) -> str:
    text = _own_text(type_name)
    for nested in sorted(_nested_types(text, type_name.partition("/")[0])):
        if nested not in seen:
            seen.add(nested)
            text += f"\n{_SEPARATOR}\nMSG: {nested}\n" + _with_nested(nested, seen)
    return text


def _nested_types(text: str, package: str) -> set[str]:
    """Types named in a definition, as ``package/Name``."""
    names = {name for name in _FIELD_TYPE.findall(text) if not _PRIMITIVE.fullmatch(name)}
    return {name if "/" in name else f"{package}/{name}" for name in names}


def _own_text(type_name: str) -> str:
    """Text of a single type: its .msg file, or else what the type store knows."""
    package, name = _split(type_name)
    for folder in _definition_folders(package):
        path = folder / f"{name}.msg"
        if path.is_file():
            return path.read_text("utf-8")
    full_name = f"{package}/msg/{name}"
    message_class(full_name)
    return typestore().gendefhash(full_name, {}, ros_version=2)[0]


def _own_definitions() -> Path:
    """Folder with the .msg files of ``dopslam_msgs``."""
    folders = list(_definition_folders(PACKAGE))
    for folder in folders:
        if any(folder.glob("*.msg")):
            return folder
    places = ", ".join(f"'{folder}'" for folder in folders)
    raise BagTypeError(
        f"the message definitions of {PACKAGE} are in none of {places}: build and install "
        f"{PACKAGE}, or source the workspace it is in"
    )


def _definition_folders(package: str) -> Iterator[Path]:
    """Where the .msg files of a package may be, in the order of preference."""
    prefixes = [p for p in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if p]
    for prefix in [*prefixes, sys.prefix]:
        yield Path(prefix) / "share" / package / "msg"
    if package == PACKAGE:
        yield _SOURCE_TREE


def _unknown(type_name: str) -> BagTypeError:
    return BagTypeError(
        f"message type {type_name!r} is neither one of ROS 2 Jazzy's common types nor of "
        f"{PACKAGE}: give its definition and its hash yourself, or check the spelling "
        "('package/msg/Name')"
    )
