"""The parameters of the filter node."""

from __future__ import annotations

from dataclasses import dataclass

from dopslam_ros.core.pmb import FilterParameters
from dopslam_ros.core.settings.parameters import parameter
from dopslam_ros.messages.filter_output import DrawingParameters


@dataclass(frozen=True)
class StorageParameters:
    """Where maps and snapshots are, and what a filter starts from."""

    map_directory: str = parameter(
        "~/.ros/dopslam",
        "Folder of all maps and snapshots; nothing is read or written elsewhere. It is made when"
        " something is saved.",
    )
    map: str = parameter("", "Name of a map to start with, in map_directory; empty: none.")
    snapshot: str = parameter(
        "",
        "Name of a file in map_directory that has the state of the filter all the time, so that it"
        " can go on where it was; empty: none.",
    )
    snapshot_period: float = parameter(
        0.5, "Time between two snapshots.", unit="s", low=0.01, high=1.0
    )
    resume: bool = parameter(False, "Whether to go on from the snapshot when there is one.")
    resume_age: float = parameter(
        60.0,
        "A snapshot written longer ago than this is too old to go on from.",
        unit="s",
        low=0.0,
        high=1e9,
    )


@dataclass(frozen=True)
class FilterNodeParameters(StorageParameters, DrawingParameters, FilterParameters):
    """The filter's settings and the node's own."""

    map_frame: str = parameter("map", "Frame of everything that is estimated.")
    base_frame: str = parameter("base_link", "Frame of the vehicle.")
    publish_tf: bool = parameter(
        False, "Whether the pose is published on /tf, too, as the transform from map to base frame."
    )
    most_waiting: int = parameter(
        100,
        "Sets, and controls, that may wait when they come faster than they can be processed. When"
        " more do, the oldest are dropped, counted as overload_dropped, and predicted through; a"
        " replay, which has time, uses them.",
        low=1,
        high=100_000,
    )
    wait_for_nodes: str = parameter(
        "", "Names of nodes, separated by commas, that must get the results before any is made."
    )
