"""Messages that the filter gets: measurement sets and controls."""

from __future__ import annotations

from operator import attrgetter
from typing import Any

import numpy as np

from dopslam_ros.bag import record_type
from dopslam_ros.core.models.measurements import MOST_PATHS, MeasurementSet, checked_measurements
from dopslam_ros.core.models.motion import Control
from dopslam_ros.core.settings.layout import COMPONENTS, DIM
from dopslam_ros.messages import topics
from dopslam_ros.messages.common import Frames, InvalidMessage, Types, make_header, make_twist

_components = attrgetter(*COMPONENTS)


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
