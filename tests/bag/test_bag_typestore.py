"""Message types, with the installed files, rosbags and rclpy as witnesses."""

from __future__ import annotations

import importlib
import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rclpy.serialization import deserialize_message, serialize_message
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from dopslam_ros.bag import (
    BagTypeError,
    canonical,
    definition,
    deserialize,
    message_class,
    serialize,
    type_hash,
    typestore,
)

module = sys.modules["dopslam_ros.bag.typestore"]  # the function of that name hides it

OWN = [
    f"dopslam_msgs/msg/{name}"
    for name in (
        "ChannelMeasurement",
        "ChannelMeasurementSet",
        "ErrorBounds",
        "Landmark",
        "LandmarkBound",
        "LandmarkMap",
        "UeState",
    )
]
EXCHANGED = [
    "dopslam_msgs/msg/UeState",
    "dopslam_msgs/msg/LandmarkMap",
    "dopslam_msgs/msg/ChannelMeasurementSet",
    "dopslam_msgs/msg/ErrorBounds",
    "nav_msgs/msg/Odometry",
    "nav_msgs/msg/Path",
    "visualization_msgs/msg/MarkerArray",
    "diagnostic_msgs/msg/DiagnosticArray",
]
SHARE = Path(sys.prefix) / "share"


@pytest.fixture(autouse=True)
def fresh_caches() -> Iterator[None]:
    """Look for definitions anew in each test, and after it."""
    caches = [typestore, message_class, type_hash, definition]
    for cached in caches:
        cached.cache_clear()
    yield
    for cached in caches:
        cached.cache_clear()


@pytest.mark.parametrize("type_name", [*OWN, "nav_msgs/msg/Odometry"])
def test_hash_is_the_installed_one(type_name: str) -> None:
    path = SHARE / f"{type_name}.json"
    if not path.is_file():
        pytest.skip(f"{path} is not installed")
    hashes = {h["type_name"]: h["hash_string"] for h in json.loads(path.read_text())["type_hashes"]}
    assert type_hash(type_name) == hashes[type_name]


@pytest.mark.parametrize("type_name", [*OWN, "visualization_msgs/msg/MarkerArray"])
def test_definition_says_the_same_as_the_type(type_name: str) -> None:
    own, *nested = definition(type_name).split("\n" + "=" * 80 + "\nMSG: ")
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(own, type_name))
    for part in nested:
        name, _, text = part.partition("\n")
        store.register(get_types_from_msg(text, name.replace("/", "/msg/")))
    assert store.hash_rihs01(type_name) == type_hash(type_name)


@pytest.mark.parametrize("type_name", OWN)
def test_definition_contains_the_installed_files(type_name: str) -> None:
    path = SHARE / f"{type_name}.msg"
    if not path.is_file():
        pytest.skip(f"{path} is not installed")
    own, *nested = definition(type_name).split("\n" + "=" * 80 + "\nMSG: ")
    assert own == path.read_text()
    for part in nested:
        name, _, text = part.partition("\n")
        assert text == (SHARE / f"{name.replace('/', '/msg/')}.msg").read_text()


def test_definition_without_installed_packages(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("AMENT_PREFIX_PATH", raising=False)
    monkeypatch.setattr(sys, "prefix", "/nonexistent")
    text = definition("dopslam_msgs/msg/UeState")
    assert text.startswith("# State of the vehicle")
    assert text.endswith(
        "\n" + "=" * 80 + "\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
        "\n" + "=" * 80 + "\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
    )


def test_nested_types_follow_where_they_are_first_used() -> None:
    names = re.findall(r"^MSG: (.*)$", definition("dopslam_msgs/msg/LandmarkMap"), re.M)
    assert names == [
        "dopslam_msgs/Landmark",
        "geometry_msgs/Point",
        "std_msgs/Header",
        "builtin_interfaces/Time",
    ]


def test_sourced_workspace_comes_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "share" / "dopslam_msgs" / "msg"
    folder.mkdir(parents=True)
    (folder / "Only.msg").write_text("uint8 here\n")
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"/nonexistent:{tmp_path}")
    assert definition("dopslam_msgs/msg/Only") == "uint8 here\n"
    assert "dopslam_msgs/msg/UeState" not in typestore().types


def test_types_of_any_installed_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "share" / "odd_msgs" / "msg"
    folder.mkdir(parents=True)
    (folder / "Odd.msg").write_text("std_msgs/Header header\nstring<=5[<=3] names\nint8 A=3\n")
    hashes = [{"type_name": "odd_msgs/msg/Odd", "hash_string": "RIHS01_5"}]
    (folder / "Odd.json").write_text(json.dumps({"type_hashes": hashes}))
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path))
    names = re.findall(r"^MSG: (.*)$", definition("odd_msgs/msg/Odd"), re.M)
    assert names == ["std_msgs/Header", "builtin_interfaces/Time"]
    assert type_hash("odd_msgs/msg/Odd") == "RIHS01_5"


def test_missing_definitions_name_the_places(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AMENT_PREFIX_PATH", "/workspace")
    monkeypatch.setattr(sys, "prefix", "/environment")
    monkeypatch.setattr(module, "_SOURCE_TREE", Path("/source"))
    with pytest.raises(BagTypeError) as caught:
        typestore()
    for place in ("/workspace/share", "/environment/share", "/source", "build and install"):
        assert place in str(caught.value)


@pytest.mark.parametrize("function", [definition, type_hash, message_class])
def test_unknown_types_are_named(function: Any) -> None:
    with pytest.raises(BagTypeError, match="'nowhere_msgs/msg/Nothing'"):
        function("nowhere_msgs/msg/Nothing")


@pytest.mark.parametrize("name", ["", "UeState", "../x/msg/Y", "a/b/c/d", "a/msg/../b"])
def test_names_that_are_no_type_names(name: str) -> None:
    with pytest.raises(BagTypeError, match="package/msg/Name"):
        definition(name)


@pytest.mark.parametrize("type_name", EXCHANGED)
def test_bytes_are_those_of_rclpy(type_name: str) -> None:
    """Equal but for the gaps that align fields, where rclpy leaves what the memory contained."""
    rng = np.random.default_rng(2)
    for _ in range(30):
        ours, theirs = _random_message(type_name, rng)
        payload, reference = serialize(ours, type_name), serialize_message(theirs)
        gaps = _gaps(ours, type_name)
        assert len(payload) == len(reference) + -len(reference) % 4
        assert not any(payload[len(reference) :])
        assert {i for i in range(len(reference)) if payload[i] != reference[i]} <= gaps
        assert not any(payload[i] for i in gaps)
        assert canonical(reference, type_name) == payload
        assert serialize(deserialize(payload, type_name), type_name) == payload
        assert canonical(serialize_message(_received(payload, theirs)), type_name) == payload


def test_message_that_does_not_fit() -> None:
    state = message_class("dopslam_msgs/msg/UeState")
    with pytest.raises(BagTypeError, match="UeState"):
        serialize(object(), "dopslam_msgs/msg/UeState")
    with pytest.raises(BagTypeError, match="Odometry"):
        serialize(state.__new__(state), "nav_msgs/msg/Odometry")


@pytest.mark.parametrize("type_name", EXCHANGED)
def test_bytes_that_do_not_fit(type_name: str) -> None:
    rng = np.random.default_rng(3)
    whole = serialize(_random_message(type_name, rng)[0], type_name)
    for _ in range(100):
        payload = bytearray(whole)
        payload[int(rng.integers(len(payload)))] ^= 1 << int(rng.integers(8))
        _deserialize_or_refuse(bytes(payload), type_name)
        _deserialize_or_refuse(whole[: int(rng.integers(len(whole)))], type_name)
        _deserialize_or_refuse(b"\0\1\0\0" + rng.bytes(100), type_name)


def _deserialize_or_refuse(payload: bytes, type_name: str) -> None:
    try:
        deserialize(payload, type_name)
    except BagTypeError:
        pass


def _received(payload: bytes, like: Any) -> Any:
    return deserialize_message(payload, type(like))


def _gaps(message: object, type_name: str) -> set[int]:
    """Bytes of a serialised message that belong to no field: those that keep what was there."""
    store = typestore()
    layout = store.get_msgdef(type_name)
    size = layout.getsize_cdr(0, message, store)
    zeros, ones = bytearray(size), bytearray(b"\xff" * size)
    layout.serialize_cdr_le(memoryview(zeros), 0, message, store)
    layout.serialize_cdr_le(memoryview(ones), 0, message, store)
    return {4 + i for i in range(size) if zeros[i] != ones[i]}


def _random_message(type_name: str, rng: np.random.Generator) -> tuple[Any, Any]:
    """The same random message for rosbags and for rclpy."""
    package, _, name = type_name.split("/")
    theirs = getattr(importlib.import_module(f"{package}.msg"), name)()
    fields: dict[str, Any] = {}
    for field, (kind, description) in typestore().fielddefs[type_name][1]:
        ours, value = _random_field(kind, description, rng)
        fields[field] = ours
        setattr(theirs, field, value)
    return message_class(type_name)(**fields), theirs


def _random_field(kind: Any, description: Any, rng: np.random.Generator) -> tuple[Any, Any]:
    if kind == Nodetype.NAME:
        return _random_message(description, rng)
    if kind == Nodetype.BASE:
        value = _random_value(description[0], rng)
        return value, bytes([value]) if description[0] == "byte" else value
    (element, inner), bound = description
    count = bound if kind == Nodetype.ARRAY else int(rng.integers(0, 6))
    pairs = [_random_field(element, inner, rng) for _ in range(count)]
    ours, theirs = [pair[0] for pair in pairs], [pair[1] for pair in pairs]
    if element == Nodetype.NAME or inner[0] == "string":
        return ours, theirs
    array = np.array(ours, dtype=inner[0])
    return array, array if kind == Nodetype.ARRAY else theirs


def _random_value(base: str, rng: np.random.Generator) -> Any:
    if base == "string":
        return "".join(rng.choice(list("abc/é漢"), int(rng.integers(0, 12))))
    if base == "bool":
        return bool(rng.integers(2))
    if base.startswith("float"):
        return float(np.dtype(base).type(rng.choice([np.nan, np.inf, -0.0, rng.normal()])))
    if base in {"byte", "char"}:
        return int(rng.integers(128))
    limits = np.iinfo(base)
    return int(rng.integers(limits.min, limits.max, endpoint=True, dtype=base))
