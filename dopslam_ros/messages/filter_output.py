"""What the filter node publishes after a step: poses, path, map and markers as messages."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from dopslam_ros.core.linalg.arrays import FloatArray
from dopslam_ros.core.linalg.quantiles import chi_square
from dopslam_ros.core.pmb import LandmarkEstimates
from dopslam_ros.core.session.filtering import FilterOutput
from dopslam_ros.core.settings.layout import LandmarkType
from dopslam_ros.core.settings.parameters import parameter
from dopslam_ros.messages import topics
from dopslam_ros.messages.conversion import (
    BS_ID,
    Frames,
    Types,
    make_header,
    make_map,
    make_point,
    make_quaternion,
    make_twist,
    make_ue_state,
    make_vector,
)

# The ellipsoids that are drawn hold the landmark with this probability.
ELLIPSOID_PROBABILITY = 0.95
_STDS = math.sqrt(float(chi_square(ELLIPSOID_PROBABILITY, 3)))
_ELLIPSOID_OPACITY = 0.25
# Of each axis the two others, in the order in which a rotation takes the first to the second.
_BEFORE, _AFTER = [1, 2, 0], [2, 0, 1]
# What of a pose in space is estimated.
_PLANAR = np.ix_([0, 1, 5], [0, 1, 5])


class Look(NamedTuple):
    """How a type of landmarks is drawn: shape of the body, its size [m], colour."""

    name: str
    shape: int
    size: float
    colour: tuple[float, float, float]


_BALL = 2
LOOKS = {
    int(LandmarkType.BS): Look("BS", 3, 4.0, (0.1, 0.1, 0.1)),
    int(LandmarkType.VA): Look("VA", 1, 3.0, (0.0, 0.45, 0.7)),
    int(LandmarkType.SP): Look("SP", _BALL, 2.0, (0.85, 0.37, 0.0)),
}


@dataclass(frozen=True)
class DrawingParameters:
    """How often and how long what is only drawn is sent: it grows, and eyes are slow."""

    path_poses: int = parameter(1000, "Most poses that the path keeps.", low=1, high=1_000_000)
    path_spacing: float = parameter(
        0.5, "Least time between two poses of the path.", unit="s", low=0.0, high=3600.0
    )
    path_period: float = parameter(
        2.0, "Least time between two paths.", unit="s", low=0.0, high=3600.0
    )
    markers_period: float = parameter(
        1.0, "Least time between two arrays of markers.", unit="s", low=0.0, high=3600.0
    )


@dataclass
class FilterMessages:
    """Turns filter outputs into messages; remembers the path driven and the markers shown.

    Attributes:
        types: finds message classes.
        bs: (3,) position of the BS [m].
        ue_height: height of the vehicle's antenna [m].
        frames: names of the frames.
        drawing: how often what is only drawn is sent.
        transforms: whether the pose comes as a transform, too.
    """

    types: Types
    bs: FloatArray
    ue_height: float = 0.0
    frames: Frames = field(default_factory=Frames)
    drawing: DrawingParameters = field(default_factory=DrawingParameters)
    transforms: bool = False

    def __post_init__(self) -> None:
        self._poses: list[Any] = []
        self._sent: dict[str, int] = {}
        self._shown: set[tuple[str, int]] = set()
        types = self.types
        self._bs = make_point(types, tuple(map(float, self.bs)))
        self._upright = make_quaternion(types, (0.0, 0.0, 0.0, 1.0))
        self._sizes = {k: make_vector(types, (look.size,) * 3) for k, look in LOOKS.items()}
        self._tints = {k: _colour(types, look, _ELLIPSOID_OPACITY) for k, look in LOOKS.items()}
        # What every marker has and none uses.
        self._unused: dict[str, Any] = {
            "lifetime": types("builtin_interfaces/msg/Duration")(sec=0, nanosec=0),
            "frame_locked": False,
            "points": [],
            "colors": [],
            "texture_resource": "",
            "uv_coordinates": [],
            "text": "",
            "mesh_resource": "",
            "mesh_use_embedded_materials": False,
            "texture": types("sensor_msgs/msg/CompressedImage")(
                header=make_header(types, 0, ""), format="", data=np.zeros(0, np.uint8)
            ),
            "mesh_file": types("visualization_msgs/msg/MeshFile")(
                filename="", data=np.zeros(0, np.uint8)
            ),
        }

    def of(self, output: FilterOutput) -> Iterator[tuple[topics.Topic, Any]]:
        """The messages of one output, in the order in which they are to be sent.

        The vehicle comes first, so that it can be on its way before the map is worked out. Path and
        markers come with some outputs only, chosen by their times, so that a replay chooses the
        same.
        """
        types, frames, time_ns = self.types, self.frames, output.stamp_ns
        mean, covariance = output.state.ue_mean, output.state.ue_covariance
        header = make_header(types, time_ns, frames.map)
        pose = self._pose(mean)
        with_covariance = types("geometry_msgs/msg/PoseWithCovariance")(
            pose=pose, covariance=_pose_covariance(covariance)
        )
        yield (
            topics.UE_POSE,
            types(topics.UE_POSE.type_name)(header=header, pose=with_covariance),
        )
        odometry = types(topics.ODOMETRY.type_name)(
            header=header,
            child_frame_id=frames.base,
            pose=with_covariance,
            twist=types("geometry_msgs/msg/TwistWithCovariance")(
                twist=make_twist(types, output.control), covariance=np.zeros(36)
            ),
        )
        yield topics.UE_STATE, make_ue_state(types, time_ns, mean, covariance, frames)
        yield topics.ODOMETRY, odometry
        if self.transforms:
            yield topics.TF, self._transform(header, pose)
        yield topics.LANDMARKS, make_map(types, time_ns, output.landmarks, self.bs, frames)
        if output.anew:
            self._poses.clear()
        if self._due("pose", time_ns, self.drawing.path_spacing):
            self._poses.append(types("geometry_msgs/msg/PoseStamped")(header=header, pose=pose))
            del self._poses[: -self.drawing.path_poses]
        if self._due(topics.PATH.name, time_ns, self.drawing.path_period):
            path = types(topics.PATH.type_name)(header=header, poses=list(self._poses))
            yield topics.PATH, path
        if self._due(topics.LANDMARK_MARKERS.name, time_ns, self.drawing.markers_period):
            yield topics.LANDMARK_MARKERS, self._markers(time_ns, output.landmarks)

    def _transform(self, header: Any, pose: Any) -> Any:
        """The vehicle's frame in that of the map."""
        p, types = pose.position, self.types
        transform = types("geometry_msgs/msg/Transform")(
            translation=types("geometry_msgs/msg/Vector3")(x=p.x, y=p.y, z=p.z),
            rotation=pose.orientation,
        )
        stamped = types("geometry_msgs/msg/TransformStamped")(
            header=header, child_frame_id=self.frames.base, transform=transform
        )
        return types(topics.TF.type_name)(transforms=[stamped])

    def _due(self, what: str, time_ns: int, period: float) -> bool:
        """Whether the last one is long enough ago."""
        last = self._sent.get(what)
        due = last is None or not 0 <= time_ns - last < round(period * 1e9)
        if due:
            self._sent[what] = time_ns
        return due

    def _pose(self, mean: FloatArray) -> Any:
        x, y, heading, _ = mean.tolist()
        return self.types("geometry_msgs/msg/Pose")(
            position=make_point(self.types, (x, y, self.ue_height)),
            orientation=make_quaternion(
                self.types, (0.0, 0.0, math.sin(0.5 * heading), math.cos(0.5 * heading))
            ),
        )

    def _markers(self, time_ns: int, landmarks: LandmarkEstimates) -> Any:
        """A solid body and an ellipsoid per landmark; DELETE for what is gone."""
        types = self.types
        header = make_header(types, time_ns, self.frames.map)
        bs = ("BS", BS_ID)
        markers, shown = [self._body(header, bs, LandmarkType.BS, self._bs, 1.0)], {bs}
        sizes, rotations = _ellipsoids(landmarks.covariances)
        for landmark, kind, position, existence, size, rotation in zip(
            landmarks.ids.tolist(),
            landmarks.types.tolist(),
            landmarks.positions.tolist(),
            landmarks.existence.tolist(),
            sizes.tolist(),
            rotations.tolist(),
            strict=True,
        ):
            name, point = LOOKS[kind].name, make_point(types, position)
            body, ellipsoid = (name, landmark), (f"{name}_ellipsoid", landmark)
            shown |= {body, ellipsoid}
            turned, diameters = make_quaternion(types, rotation), make_vector(types, size)
            tint = self._tints[kind]
            markers += [
                self._body(header, body, kind, point, existence),
                self._marker(header, ellipsoid, _BALL, point, turned, diameters, tint),
            ]
        gone = sorted(self._shown - shown)
        self._shown = shown
        markers += [self._deletion(header, key) for key in gone]
        return types(topics.LANDMARK_MARKERS.type_name)(markers=markers)

    def _body(
        self, header: Any, key: tuple[str, int], kind: int, point: Any, existence: float
    ) -> Any:
        look, size = LOOKS[kind], self._sizes[kind]
        colour = _colour(self.types, look, existence)
        return self._marker(header, key, look.shape, point, self._upright, size, colour)

    def _deletion(self, header: Any, key: tuple[str, int]) -> Any:
        types = self.types
        nowhere, size = make_point(types, (0.0,) * 3), make_vector(types, (1.0,) * 3)
        colour = types("std_msgs/msg/ColorRGBA")(r=0.0, g=0.0, b=0.0, a=0.0)
        return self._marker(header, key, _BALL, nowhere, self._upright, size, colour, action=2)

    def _marker(
        self,
        header: Any,
        key: tuple[str, int],
        shape: int,
        point: Any,
        orientation: Any,
        size: Any,
        colour: Any,
        action: int = 0,
    ) -> Any:
        return self.types("visualization_msgs/msg/Marker")(
            header=header,
            ns=key[0],
            id=key[1],
            type=shape,
            action=action,
            pose=self.types("geometry_msgs/msg/Pose")(position=point, orientation=orientation),
            scale=size,
            color=colour,
            **self._unused,
        )


def _colour(types: Types, look: Look, opacity: float) -> Any:
    r, g, b = look.colour
    return types("std_msgs/msg/ColorRGBA")(r=r, g=g, b=b, a=opacity)


def _ellipsoids(covariances: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(L, 3) diameters [m] and (L, 4) quaternions of the regions of ELLIPSOID_PROBABILITY."""
    variances, axes = np.linalg.eigh(covariances)
    axes *= np.sign(np.linalg.det(axes))[:, None, None]
    size = 2.0 * _STDS * np.sqrt(np.maximum(variances, 0.0))
    return np.maximum(size, 1e-3), quaternions(axes)


def quaternions(rotations: FloatArray) -> FloatArray:
    """(L, 4) x, y, z, w of rotations (L, 3, 3): the longest row of 4 q q', with length one."""
    count = len(rotations)
    diagonal = rotations.reshape(count, 9)[:, ::4]
    trace = diagonal[:, 0] + diagonal[:, 1] + diagonal[:, 2]
    products = np.empty((count, 4, 4))
    products[:, :3, :3] = rotations + rotations.swapaxes(1, 2)
    turned = rotations[:, _AFTER, _BEFORE] - rotations[:, _BEFORE, _AFTER]
    products[:, :3, 3] = products[:, 3, :3] = turned
    products.reshape(count, 16)[:, :15:5] += (1.0 - trace)[:, None]
    products[:, 3, 3] = 1.0 + trace
    longest = np.column_stack((diagonal, trace)).argmax(axis=1)
    row = products[np.arange(count), longest]
    return row / np.sqrt(np.square(row).sum(axis=1, keepdims=True))


def _pose_covariance(covariance: FloatArray) -> FloatArray:
    """(36,) row-major over x, y, z, roll, pitch, yaw (REP-103) from (4, 4); the rest is known."""
    pose = np.zeros((6, 6))
    pose[_PLANAR] = covariance[:3, :3]
    return pose.reshape(-1)
