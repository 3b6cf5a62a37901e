"""The layouts of RViz and Foxglove show topics that exist, with types that their displays take."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from dopslam_ros.bag import BagReader, deserialize
from dopslam_ros.messages import topics

ROOT = Path(__file__).resolve().parents[1]
TOPICS = {topic.name.strip("/"): topic for topic in (*topics.RECORDED, topics.FILTER_EVENTS)}
# What each display of RViz subscribes to.
RVIZ_TYPES = {
    "rviz_default_plugins/MarkerArray": "visualization_msgs/msg/MarkerArray",
    "rviz_default_plugins/Path": "nav_msgs/msg/Path",
    "rviz_default_plugins/PoseWithCovariance": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "rviz_default_plugins/Odometry": "nav_msgs/msg/Odometry",
}
# What Foxglove draws in its 3D panel.
FOXGLOVE_TYPES = set(RVIZ_TYPES.values())


@pytest.fixture(scope="module")
def rviz() -> dict[str, Any]:
    content = yaml.safe_load((ROOT / "config" / "dopslam.rviz").read_text("utf-8"))
    found: dict[str, Any] = content["Visualization Manager"]
    return found


@pytest.fixture(scope="module")
def foxglove() -> dict[str, Any]:
    found: dict[str, Any] = json.loads((ROOT / "config" / "foxglove_layout.json").read_text())
    return found


def test_rviz_subscribes_as_the_topics_are_offered(rviz: dict[str, Any]) -> None:
    """Names relative, types right, latched topics read as latched."""
    shown = [display for display in rviz["Displays"] if "Topic" in display]
    assert {display["Class"] for display in shown} == set(RVIZ_TYPES)
    for display in shown:
        subscription = display["Topic"]
        topic = TOPICS[subscription["Value"]]
        assert topic.type_name == RVIZ_TYPES[display["Class"]]
        assert subscription["Reliability Policy"] == "Reliable"
        expected = "Transient Local" if topic.latched else "Volatile"
        assert subscription["Durability Policy"] == expected


def test_rviz_needs_no_transform(rviz: dict[str, Any]) -> None:
    """Its fixed frame is the frame of every message it shows, in a recorded run."""
    frame = rviz["Global Options"]["Fixed Frame"]
    names = {"/" + d["Topic"]["Value"] for d in rviz["Displays"] if "Topic" in d}
    seen = set()
    for message in BagReader(ROOT / "bags" / "paper").messages(names):
        content: Any = deserialize(message.payload, message.type_name)
        headers = [m.header for m in getattr(content, "markers", [])] or [content.header]
        assert {header.frame_id for header in headers} == {frame}
        seen.add(message.topic)
    assert seen == names


def test_rviz_lists_the_namespaces_of_the_markers(rviz: dict[str, Any]) -> None:
    """Those that are published in a run, and no other."""
    (display,) = [d for d in rviz["Displays"] if d["Class"].endswith("/MarkerArray")]
    found = {
        marker.ns
        for message in BagReader(ROOT / "bags" / "paper").messages({"/landmark_markers"})
        for marker in deserialize(message.payload, message.type_name).markers  # type: ignore[attr-defined]
    }
    assert set(display["Namespaces"]) == found


def message_paths(config: dict[str, Any]) -> Iterator[str]:
    """The message paths of all plots."""
    for panel in config["configById"].values():
        for path in panel.get("paths", []):
            yield path["value"]


def test_foxglove_draws_topics_that_exist(foxglove: dict[str, Any]) -> None:
    """In the 3D panel, with types that it draws, in the frame it follows."""
    shown = foxglove["configById"]["3D!map"]["topics"]
    assert {TOPICS[name.strip("/")].type_name for name in shown} == FOXGLOVE_TYPES
    assert foxglove["configById"]["3D!map"]["followTf"] == "map"


def test_foxglove_plots_fields_that_exist(foxglove: dict[str, Any]) -> None:
    """Each path leads to a number in a message of the recorded run."""
    first = {}
    for message in BagReader(ROOT / "bags" / "paper").messages(None):
        first.setdefault(message.topic, message)
    plotted = list(message_paths(foxglove))
    assert len(plotted) >= 6
    for path in plotted:
        match = re.fullmatch(r"(/[a-z_/]+)\.([a-z_]+)(?:\[(\d+)\])?(?:\.@sqrt)?", path)
        assert match is not None, path
        message = first[match.group(1)]
        value: Any = getattr(deserialize(message.payload, message.type_name), match.group(2))
        assert isinstance(float(value if match.group(3) is None else value[int(match[3])]), float)


def test_foxglove_places_every_panel(foxglove: dict[str, Any]) -> None:
    """The tree of the layout names each configured panel once."""

    def leaves(tree: Any) -> Iterator[str]:
        if isinstance(tree, str):
            yield tree
        else:
            yield from leaves(tree["first"])
            yield from leaves(tree["second"])

    assert sorted(leaves(foxglove["layout"])) == sorted(foxglove["configById"])
