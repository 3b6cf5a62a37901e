"""Serialisation, with the one of rosbags as the witness: equal bytes for every type there is."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from rosbags.interfaces import Nodetype

from dopslam_ros.bag import BagTypeError, message_class, record_type, serialize, typestore

LANDMARK = "dopslam_msgs/msg/Landmark"
MAP = "dopslam_msgs/msg/LandmarkMap"


def expected(message: object, type_name: str) -> bytes:
    """What rosbags makes of a message, padded to whole words."""
    payload = bytes(typestore().serialize_cdr(message, type_name, little_endian=True))
    return payload + bytes(-len(payload) % 4)


@pytest.mark.parametrize("type_name", sorted(typestore().types))
def test_every_type_as_rosbags_has_it(type_name: str) -> None:
    rng = np.random.default_rng(1)
    for _ in range(12):
        message = random_message(type_name, rng)
        assert serialize(message, type_name) == expected(message, type_name)


@pytest.mark.parametrize("frame", ["", "m", "ab", "map", "odom", "world"])
@pytest.mark.parametrize("count", [0, 1, 2, 7])
@pytest.mark.parametrize(
    ("outer", "inner", "field"),
    [
        (MAP, LANDMARK, "landmarks"),
        ("dopslam_msgs/msg/ErrorBounds", "dopslam_msgs/msg/LandmarkBound", "landmarks"),
        ("dopslam_msgs/msg/ChannelMeasurementSet", "dopslam_msgs/msg/ChannelMeasurement", "paths"),
        ("geometry_msgs/msg/PolygonStamped", "geometry_msgs/msg/Point32", ""),
        ("geometry_msgs/msg/PoseArray", "geometry_msgs/msg/Pose", "poses"),
        ("sensor_msgs/msg/MultiDOFJointState", "geometry_msgs/msg/Transform", "transforms"),
    ],
)
def test_arrays_are_lists_of_messages(
    outer: str, inner: str, field: str, count: int, frame: str
) -> None:
    """An array of records gives what the list of messages gives, wherever in the stream it is."""
    rng = np.random.default_rng(2)
    message = random_message(outer, rng)
    message.header.frame_id = frame
    holder, name = (message.polygon, "points") if not field else (message, field)
    messages = [random_message(inner, rng) for _ in range(count)]
    setattr(holder, name, messages)
    wanted = expected(message, outer)
    records = np.zeros(count, record_type(inner))
    for number, single in enumerate(messages):
        copy_fields(single, records[number])
    setattr(holder, name, records)
    assert serialize(message, outer) == wanted


def copy_fields(message: Any, record: Any) -> None:
    """The fields of a message into a record of the same type."""
    for name in record.dtype.names:
        value = getattr(message, name)
        if record.dtype[name].names:
            copy_fields(value, record[name])
        else:
            record[name] = value


def test_records_that_do_not_fit() -> None:
    message = random_message(MAP, np.random.default_rng(3))
    message.landmarks = np.zeros(2, record_type("dopslam_msgs/msg/LandmarkBound"))
    with pytest.raises(BagTypeError, match="in the place of dopslam_msgs/msg/Landmark"):
        serialize(message, MAP)
    with pytest.raises(BagTypeError, match="no fixed size: frame_id"):
        record_type("std_msgs/msg/Header")


@pytest.mark.parametrize(
    "wrong",
    [np.zeros(8), np.zeros(10), np.zeros(9, np.float32), np.zeros((3, 3)), [0.0] * 9, None, 1.0],
    ids=repr,
)
def test_arrays_that_do_not_fit(wrong: Any) -> None:
    message = random_message(LANDMARK, np.random.default_rng(4))
    message.covariance = wrong
    with pytest.raises(BagTypeError, match="is no dopslam_msgs/msg/Landmark"):
        serialize(message, LANDMARK)


@pytest.mark.parametrize(
    ("field", "wrong"), [("id", -1), ("type", 256), ("id", 2**32), ("id", 1.5)]
)
def test_numbers_that_do_not_fit(field: str, wrong: Any) -> None:
    message = random_message(LANDMARK, np.random.default_rng(5))
    setattr(message, field, wrong)
    with pytest.raises(BagTypeError, match="is no dopslam_msgs/msg/Landmark"):
        serialize(message, LANDMARK)


def random_message(type_name: str, rng: np.random.Generator) -> Any:
    """A message with random content."""
    fields = typestore().fielddefs[type_name][1]
    # By position: names that are words of Python are spelt differently in the class.
    return message_class(type_name)(*(random_value(kind, what, rng) for _, (kind, what) in fields))


def random_value(kind: Any, what: Any, rng: np.random.Generator) -> Any:
    """A random value of a field."""
    if kind == Nodetype.NAME:
        return random_message(what, rng)
    if kind == Nodetype.BASE:
        return random_base(what[0], rng)
    (element, inner), bound = what
    count = bound if kind == Nodetype.ARRAY else int(rng.integers(0, 4))
    values = [random_value(element, inner, rng) for _ in range(count)]
    if element == Nodetype.NAME or inner[0] == "string":
        return values
    return np.array(values, dtype={"byte": "uint8", "char": "uint8"}.get(inner[0], inner[0]))


def random_base(base: str, rng: np.random.Generator) -> Any:
    """A random number or text."""
    if base == "string":
        return "".join(rng.choice(list("abc/é漢"), int(rng.integers(0, 9))))
    if base == "bool":
        return bool(rng.integers(2))
    if base.startswith("float"):
        return float(np.dtype(base).type(rng.normal()))
    limits = np.iinfo({"byte": "int8", "char": "uint8"}.get(base, base))
    low = max(limits.min, 0) if base == "byte" else limits.min
    return int(rng.integers(low, limits.max, endpoint=True, dtype=limits.dtype.type))
