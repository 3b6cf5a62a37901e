"""What the filter node publishes after a step: poses, path, map and markers as messages."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from dopslam_ros.core.linalg.arrays import FloatArray
from dopslam_ros.core.session.output import FilterOutput
from dopslam_ros.core.settings.layout import HEADING, X, Y
from dopslam_ros.core.settings.parameters import parameter
from dopslam_ros.messages import topics
from dopslam_ros.messages.common import (
    Frames,
    Types,
    make_header,
    make_point,
    make_quaternion,
    make_twist,
    make_vector,
)
from dopslam_ros.messages.markers import Markers
from dopslam_ros.messages.states import make_map, make_ue_state

Message = tuple[topics.Topic, Any]
# Where the pose's components are in the vehicle's state, and in x, y, z, roll, pitch, yaw.
_ESTIMATED, _IN_SPACE = np.ix_([X, Y, HEADING], [X, Y, HEADING]), np.ix_([0, 1, 5], [0, 1, 5])


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
        self._markers = Markers(self.types, self.bs)

    def of(self, output: FilterOutput) -> Iterator[Message]:
        """The messages of one output, in the order in which they are to be sent.

        The vehicle comes first, so that it can be on its way before the map is worked out. Path and
        markers come with some outputs only, chosen by their times, so that a replay chooses the
        same.
        """
        types, frames, time_ns = self.types, self.frames, output.stamp_ns
        header = make_header(types, time_ns, frames.map)
        mean, covariance = output.state.ue_mean, output.state.ue_covariance
        pose = self._pose(mean)
        yield from self._vehicle(output, header, pose, mean, covariance)
        yield topics.LANDMARKS, make_map(types, time_ns, output.landmarks, self.bs, frames)
        yield from self._path(output, header, pose)
        if self._due(topics.LANDMARK_MARKERS.name, time_ns, self.drawing.markers_period):
            yield topics.LANDMARK_MARKERS, self._markers.of(header, output.landmarks)

    def _vehicle(
        self,
        output: FilterOutput,
        header: Any,
        pose: Any,
        mean: FloatArray,
        covariance: FloatArray,
    ) -> list[Message]:
        """Its pose, state and odometry, and the transform if it is wanted."""
        types, frames = self.types, self.frames
        with_covariance = types("geometry_msgs/msg/PoseWithCovariance")(
            pose=pose, covariance=_pose_covariance(covariance)
        )
        stamped = types(topics.UE_POSE.type_name)(header=header, pose=with_covariance)
        state = make_ue_state(types, output.stamp_ns, mean, covariance, frames)
        twist = types("geometry_msgs/msg/TwistWithCovariance")(
            twist=make_twist(types, output.control), covariance=np.zeros(36)
        )
        odometry = types(topics.ODOMETRY.type_name)(
            header=header, child_frame_id=frames.base, pose=with_covariance, twist=twist
        )
        found: list[Message] = [
            (topics.UE_POSE, stamped),
            (topics.UE_STATE, state),
            (topics.ODOMETRY, odometry),
        ]
        if self.transforms:
            found.append((topics.TF, self._transform(header, pose)))
        return found

    def _path(self, output: FilterOutput, header: Any, pose: Any) -> list[Message]:
        """The path, now and then."""
        time_ns = output.stamp_ns
        if output.anew:
            self._poses.clear()
        if self._due("pose", time_ns, self.drawing.path_spacing):
            stamped = self.types("geometry_msgs/msg/PoseStamped")(header=header, pose=pose)
            self._poses.append(stamped)
            del self._poses[: -self.drawing.path_poses]
        if not self._due(topics.PATH.name, time_ns, self.drawing.path_period):
            return []
        return [
            (topics.PATH, self.types(topics.PATH.type_name)(header=header, poses=[*self._poses]))
        ]

    def _transform(self, header: Any, pose: Any) -> Any:
        """The vehicle's frame in that of the map."""
        p, types = pose.position, self.types
        transform = types("geometry_msgs/msg/Transform")(
            translation=make_vector(types, (p.x, p.y, p.z)),
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
        half = 0.5 * float(mean[HEADING])
        return self.types("geometry_msgs/msg/Pose")(
            position=make_point(self.types, (float(mean[X]), float(mean[Y]), self.ue_height)),
            orientation=make_quaternion(self.types, (0.0, 0.0, math.sin(half), math.cos(half))),
        )


def _pose_covariance(covariance: FloatArray) -> FloatArray:
    """(36,) row-major over x, y, z, roll, pitch, yaw (REP-103) from (U, U); the rest is known."""
    pose = np.zeros((6, 6))
    pose[_IN_SPACE] = covariance[_ESTIMATED]
    return pose.reshape(-1)
