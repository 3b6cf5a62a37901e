"""Every topic once: its name, its type and its quality of service."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

from dopslam_ros.bag.qos import Durability, History, OfferedQos, Reliability


class Topic(NamedTuple):
    """A topic of this package.

    Attributes:
        name: relative, so that namespaces and remaps work.
        type_name: full name of the message type.
        latched: a subscriber that comes late gets the last message (transient local).
        depth: samples kept. Deep, because a set that is lost changes what the filter says.
    """

    name: str
    type_name: str
    latched: bool = False
    depth: int = 1000

    @property
    def qos(self) -> OfferedQos:
        """What we offer on it: always reliable."""
        return OfferedQos(
            history=History.KEEP_LAST,
            depth=self.depth,
            reliability=Reliability.RELIABLE,
            durability=Durability.TRANSIENT_LOCAL if self.latched else Durability.VOLATILE,
        )


CHANNEL_MEASUREMENTS = Topic("channel_measurements", "dopslam_msgs/msg/ChannelMeasurementSet")
ODOMETRY_CONTROL = Topic("odometry_control", "geometry_msgs/msg/TwistStamped")
TRUTH_UE = Topic("truth/ue", "dopslam_msgs/msg/UeState")
TRUTH_LANDMARKS = Topic("truth/landmarks", "dopslam_msgs/msg/LandmarkMap", latched=True, depth=1)

FILTER_PARAMETERS = Topic("filter_parameters", "std_msgs/msg/String", latched=True, depth=1)
# What services did to the filter; a late subscriber gets the last ones, and a replay needs all.
FILTER_EVENTS = Topic("filter_events", "dopslam_msgs/msg/FilterEvent", latched=True, depth=20)
UE_STATE = Topic("ue_state", "dopslam_msgs/msg/UeState")
UE_POSE = Topic("ue_pose", "geometry_msgs/msg/PoseWithCovarianceStamped")
ODOMETRY = Topic("odometry", "nav_msgs/msg/Odometry")
PATH = Topic("path", "nav_msgs/msg/Path", latched=True, depth=1)
LANDMARKS = Topic("landmarks", "dopslam_msgs/msg/LandmarkMap", latched=True, depth=1)
LANDMARK_MARKERS = Topic(
    "landmark_markers", "visualization_msgs/msg/MarkerArray", latched=True, depth=1
)
BOUNDS = Topic("bounds", "dopslam_msgs/msg/ErrorBounds")
# Shared by everybody, so that it is recorded only where it is asked for.
TF = Topic("/tf", "tf2_msgs/msg/TFMessage", depth=100)
DIAGNOSTICS = Topic("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray", depth=100)

INPUTS = (CHANNEL_MEASUREMENTS, ODOMETRY_CONTROL, TRUTH_UE, TRUTH_LANDMARKS)
OUTPUTS = (
    FILTER_PARAMETERS,
    UE_STATE,
    UE_POSE,
    ODOMETRY,
    PATH,
    LANDMARKS,
    LANDMARK_MARKERS,
    BOUNDS,
)


def vehicle_prefixes(recorded: Iterable[str]) -> list[str]:
    """The namespaces, with a slash at their ends, that measurement sets were recorded in."""
    ending = "/" + CHANNEL_MEASUREMENTS.name
    found = sorted(name for name in recorded if name.endswith(ending))
    return [name.removesuffix(CHANNEL_MEASUREMENTS.name) for name in found]


def output_names(recorded: Iterable[str]) -> set[str]:
    """Those of the topics recorded that the filter and the bounds of some vehicle had published."""
    prefixes = vehicle_prefixes(recorded)
    return {DIAGNOSTICS.name} | {
        prefix + t.name for prefix in prefixes for t in (FILTER_EVENTS, *OUTPUTS)
    }


# What every run has; FILTER_EVENTS are recorded too, where something happens.
RECORDED = (*INPUTS, *OUTPUTS, DIAGNOSTICS)
