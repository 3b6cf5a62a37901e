"""Between messages and the core: the only place that knows the fields of both.

The same code builds messages for the middleware and for bags: it gets a function that finds the
class of a message type: bag.message_class, or the middleware's.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

import numpy as np

from dopslam_ros.bag import BagTypeError, deserialize, record_type
from dopslam_ros.core.linalg.arrays import FloatArray, IntArray
from dopslam_ros.core.models.measurements import MOST_PATHS, MeasurementSet, checked_measurements
from dopslam_ros.core.models.motion import Control
from dopslam_ros.core.models.refusal import Refused
from dopslam_ros.core.pmb import LandmarkEstimates
from dopslam_ros.core.session.bounding import BoundsOutput, WorldState
from dopslam_ros.core.settings.layout import COMPONENTS, DIM, LandmarkType
from dopslam_ros.messages import topics

Types = Callable[[str], Any]
_components = attrgetter(*COMPONENTS)
NANO = 1_000_000_000
BS_ID = 0
# Longest set [bytes] that is looked into: more than MOST_PATHS paths take.
LARGEST_MESSAGE = 1024 * MOST_PATHS


class InvalidMessage(Refused):
    """A message that cannot be used."""


@dataclass(frozen=True)
class Frames:
    """Names of the coordinate frames."""

    map: str = "map"
    base: str = "base_link"


def stamp_ns(header: Any) -> int:
    """Time of a header [ns].

    Raises:
        InvalidMessage: the stamp is zero or malformed.
    """
    sec, nanosec = int(header.stamp.sec), int(header.stamp.nanosec)
    if (sec, nanosec) == (0, 0):
        raise InvalidMessage(
            "no_stamp", "header.stamp is zero: fill in the time of the snapshot or control"
        )
    if sec < 0 or not 0 <= nanosec < NANO:
        raise InvalidMessage("invalid_stamp", f"header.stamp {sec} s {nanosec} ns is no time")
    return sec * NANO + nanosec


def make_header(types: Types, time_ns: int, frame: str) -> Any:
    """std_msgs/Header."""
    return types("std_msgs/msg/Header")(stamp=make_time(types, time_ns), frame_id=frame)


def make_time(types: Types, time_ns: int) -> Any:
    """builtin_interfaces/Time."""
    return types("builtin_interfaces/msg/Time")(sec=time_ns // NANO, nanosec=time_ns % NANO)


def read_message(payload: bytes, topic: topics.Topic) -> Any:
    """The message that bytes from a topic or a bag hold.

    Raises:
        InvalidMessage: they hold none of the topic's type, or a set that is too large.
    """
    if topic == topics.CHANNEL_MEASUREMENTS and len(payload) > LARGEST_MESSAGE:
        raise InvalidMessage(
            "message_too_large",
            f"a set of {len(payload)} bytes: at most {LARGEST_MESSAGE} are read, and {MOST_PATHS}"
            " paths used: send the strongest",
        )
    try:
        return deserialize(payload, topic.type_name)
    except BagTypeError as error:
        raise InvalidMessage("malformed_message", str(error)) from error


# --- inputs of the filter ------------------------------------------------------------------------


def read_measurements(message: Any) -> MeasurementSet:
    """A ChannelMeasurementSet as arrays.

    Raises:
        Refused: something in it cannot be used; nothing of it is used then.
    """
    paths = message.paths
    if len(paths) > MOST_PATHS:
        raise InvalidMessage("too_many_paths", f"{len(paths)} paths: at most {MOST_PATHS} are used")
    values = np.array(list(map(_components, paths)), dtype=np.float64)
    covariances = np.array([p.covariance for p in paths], dtype=np.float64)
    return checked_measurements(values.reshape(-1, DIM), covariances.reshape(-1, DIM, DIM))


def make_measurements(
    types: Types, time_ns: int, measurements: MeasurementSet, frames: Frames
) -> Any:
    """A ChannelMeasurementSet."""
    paths = np.zeros(len(measurements), record_type("dopslam_msgs/msg/ChannelMeasurement"))
    for name, column in zip(COMPONENTS, measurements.values.T, strict=True):
        paths[name] = column
    paths["covariance"] = measurements.covariances.reshape(-1, DIM * DIM)
    paths["snr_db"] = np.nan
    return types(topics.CHANNEL_MEASUREMENTS.type_name)(
        header=make_header(types, time_ns, frames.base), paths=paths
    )


def read_control(message: Any) -> Control:
    """v and omega of a TwistStamped."""
    return Control(float(message.twist.linear.x), float(message.twist.angular.z))


def make_control(types: Types, time_ns: int, control: Control, frames: Frames) -> Any:
    """A TwistStamped in the vehicle's frame."""
    return types(topics.ODOMETRY_CONTROL.type_name)(
        header=make_header(types, time_ns, frames.base), twist=make_twist(types, control)
    )


# --- states and maps -----------------------------------------------------------------------------


def make_ue_state(
    types: Types, time_ns: int, mean: FloatArray, covariance: FloatArray, frames: Frames
) -> Any:
    """A UeState from (4,) and (4, 4)."""
    x, y, heading, bias = mean.tolist()
    return types(topics.UE_STATE.type_name)(
        header=make_header(types, time_ns, frames.map),
        x=x,
        y=y,
        heading=heading,
        clock_bias=bias,
        covariance=np.ascontiguousarray(covariance).reshape(-1),
    )


def read_ue_state(message: Any) -> tuple[FloatArray, FloatArray]:
    """(4,) mean and (4, 4) covariance of a UeState.

    Raises:
        InvalidMessage: a number is not finite.
    """
    mean = np.array([message.x, message.y, message.heading, message.clock_bias], np.float64)
    covariance = np.array(message.covariance, dtype=np.float64).reshape(4, 4)
    if not (np.isfinite(mean).all() and np.isfinite(covariance).all()):
        raise InvalidMessage("state_not_finite", "a UeState holds NaN or infinity")
    return mean, covariance


@dataclass(frozen=True)
class MapArrays:
    """A LandmarkMap as arrays: (L,) ids and types, (L, 3) positions [m], (L, 3, 3) covariances."""

    ids: IntArray
    types: IntArray
    positions: FloatArray
    covariances: FloatArray

    def at(self, ue: FloatArray) -> WorldState:
        """Vehicle (4,) and map together, where bounds can be evaluated."""
        return WorldState(ue, self.ids, self.types, self.positions)

    def of_type(self, kind: LandmarkType) -> FloatArray:
        """(n, 3) positions of the landmarks of a type."""
        return self.positions[self.types == kind]


def read_map(message: Any) -> MapArrays:
    """Arrays of a LandmarkMap.

    Raises:
        InvalidMessage: a position is not finite or a type is unknown.
    """
    landmarks = message.landmarks
    positions = np.array(
        [[m.position.x, m.position.y, m.position.z] for m in landmarks], np.float64
    ).reshape(-1, 3)
    kinds = np.array([int(m.type) for m in landmarks], dtype=np.int64)
    if not np.isfinite(positions).all():
        raise InvalidMessage("position_not_finite", "a landmark's position is NaN or infinite")
    if not np.isin(kinds, list(LandmarkType)).all():
        raise InvalidMessage("unknown_type", "a landmark's type is none of BS, VA, SP")
    covariances = np.array([m.covariance for m in landmarks], np.float64).reshape(-1, 3, 3)
    ids = np.array([int(m.id) for m in landmarks], dtype=np.int64)
    return MapArrays(ids, kinds, positions, covariances)


def make_map(
    types: Types, time_ns: int, landmarks: LandmarkEstimates, bs: FloatArray, frames: Frames
) -> Any:
    """A LandmarkMap: the BS with id 0, then the landmarks."""
    entries = np.zeros(1 + len(landmarks.ids), record_type("dopslam_msgs/msg/Landmark"))
    # The place of the BS is known: no covariance.
    for name, of_bs, of_others in (
        ("id", BS_ID, landmarks.ids),
        ("type", LandmarkType.BS, landmarks.types),
        ("type_probabilities", (1.0, 0.0, 0.0), landmarks.type_probabilities),
        ("existence_probability", 1.0, landmarks.existence),
        ("covariance", 0.0, landmarks.covariances.reshape(-1, 9)),
    ):
        entries[name][0] = of_bs
        entries[name][1:] = of_others
    for number, name in enumerate("xyz"):
        entries["position"][name][0] = bs[number]
        entries["position"][name][1:] = landmarks.positions[:, number]
    return types(topics.LANDMARKS.type_name)(
        header=make_header(types, time_ns, frames.map), landmarks=entries
    )


def true_landmarks(positions: FloatArray, kinds: IntArray) -> LandmarkEstimates:
    """The true landmarks (L, 3), (L,) as if estimated without error; ids from 1 on."""
    count = len(kinds)
    return LandmarkEstimates(
        ids=np.arange(1, count + 1),
        types=kinds,
        type_probabilities=np.eye(len(LandmarkType))[kinds],
        existence=np.ones(count),
        positions=positions,
        covariances=np.zeros((count, 3, 3)),
    )


def make_bounds(types: Types, output: BoundsOutput, frames: Frames) -> Any:
    """An ErrorBounds."""
    full, plain = output.with_doppler, output.without_doppler
    landmarks = np.zeros(len(output.ids), record_type("dopslam_msgs/msg/LandmarkBound"))
    landmarks["id"], landmarks["type"] = output.ids, output.types
    landmarks["leb"], landmarks["leb_without_doppler"] = full.leb, plain.leb
    return types(topics.BOUNDS.type_name)(
        header=make_header(types, output.stamp_ns, frames.map),
        peb=full.peb,
        heb=full.heb,
        ceb=full.ceb,
        peb_without_doppler=plain.peb,
        heb_without_doppler=plain.heb,
        ceb_without_doppler=plain.ceb,
        landmarks=landmarks,
    )


# --- others ---------------------------------------------------------------------------------------


def make_text(types: Types, text: str) -> Any:
    """A std_msgs/String."""
    return types("std_msgs/msg/String")(data=text)


def make_diagnostics(
    types: Types,
    time_ns: int,
    name: str,
    level: int,
    summary: str,
    values: Iterable[tuple[str, Any]],
) -> Any:
    """A DiagnosticArray with one status; level 0 OK, 1 WARN, 2 ERROR."""
    key_value = types("diagnostic_msgs/msg/KeyValue")
    status = types("diagnostic_msgs/msg/DiagnosticStatus")(
        level=level,
        name=name,
        message=summary,
        hardware_id="",
        values=[key_value(key=key, value=str(value)) for key, value in values],
    )
    return types(topics.DIAGNOSTICS.type_name)(
        header=make_header(types, time_ns, ""), status=[status]
    )


def make_point(types: Types, position: Sequence[float]) -> Any:
    """geometry_msgs/Point from (3,) [m]."""
    x, y, z = position
    return types("geometry_msgs/msg/Point")(x=x, y=y, z=z)


def make_quaternion(types: Types, quaternion: Sequence[float]) -> Any:
    """geometry_msgs/Quaternion from (4,) x, y, z, w."""
    x, y, z, w = quaternion
    return types("geometry_msgs/msg/Quaternion")(x=x, y=y, z=z, w=w)


def make_vector(types: Types, vector: Sequence[float]) -> Any:
    """geometry_msgs/Vector3 from (3,)."""
    x, y, z = vector
    return types("geometry_msgs/msg/Vector3")(x=x, y=y, z=z)


def make_twist(types: Types, control: Control) -> Any:
    """geometry_msgs/Twist of a vehicle that moves along its heading."""
    return types("geometry_msgs/msg/Twist")(
        linear=make_vector(types, (float(control.speed), 0.0, 0.0)),
        angular=make_vector(types, (0.0, 0.0, float(control.turn_rate))),
    )
