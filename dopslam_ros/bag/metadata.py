"""The ``metadata.yaml`` of a bag, in version 9 of rosbag2's format."""

from __future__ import annotations

import os
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from dopslam_ros.bag.errors import BagFormatError
from dopslam_ros.bag.qos import OfferedQos, to_data

FILE_NAME = "metadata.yaml"
ROS_DISTRO = "jazzy"

_VERSION = 9
_TIME_OF_NOTHING_NS = 2**63 - 1
_NO_WRAP = 2**20


class RecordedTopic(NamedTuple):
    """What the metadata say about one topic."""

    type_name: str
    type_hash: str
    qos: tuple[OfferedQos, ...]
    message_count: int


class Summary(NamedTuple):
    """What the metadata say about a bag of one file; times in [ns], None when it is empty."""

    file_name: str
    topics: Mapping[str, RecordedTopic]
    start_ns: int | None
    end_ns: int | None


def dump(summary: Summary) -> str:
    """Write the information about a bag as YAML.

    This is what an MCAP file carries in its own metadata record ``rosbag2``.
    """
    return _yaml(_information(summary)).strip()


def write(folder: Path, information: str) -> None:
    """Write ``metadata.yaml``: whole or not at all.

    Args:
        folder: Folder of the bag.
        information: What ``dump`` said about it.

    Raises:
        OSError: The disk refused.
    """
    document = f"rosbag2_bagfile_information:\n{textwrap.indent(information, '  ')}\n"
    temporary = folder / f"{FILE_NAME}.tmp"
    try:
        with temporary.open("w", encoding="utf-8") as stream:
            stream.write(document)
            stream.flush()
            os.fsync(stream.fileno())
        temporary.replace(folder / FILE_NAME)
    except OSError:
        temporary.unlink(missing_ok=True)
        raise


def listed_files(folder: Path) -> list[str] | None:
    """Names of the files of a bag in the order in which they were recorded.

    Args:
        folder: Folder of the bag.

    Returns:
        The names, or None when there is no ``metadata.yaml`` or it lists nothing.

    Raises:
        BagFormatError: The file is there but says nothing intelligible.
        OSError: The disk refused.
    """
    path = folder / FILE_NAME
    if not path.is_file():
        return None
    try:
        data = yaml.safe_load(path.read_bytes())
        names = data["rosbag2_bagfile_information"]["relative_file_paths"]
        return [Path(name).name for name in names] or None
    except (yaml.YAMLError, KeyError, TypeError, ValueError, RecursionError) as error:
        raise BagFormatError(f"'{path}' is damaged ({type(error).__name__})") from error


def _yaml(data: object) -> str:
    text = yaml.dump(data, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=_NO_WRAP)
    return str(text)


class _Dumper(yaml.SafeDumper):
    """Writes YAML the way rosbag2 does: lists indented, ``~`` for nothing, ``""`` for no text."""

    def increase_indent(self, flow: bool = False, indentless: bool = False) -> None:
        super().increase_indent(flow, False)

    def ignore_aliases(self, data: Any) -> bool:
        return True


def _represent_text(dumper: _Dumper, text: str) -> yaml.Node:
    return dumper.represent_scalar("tag:yaml.org,2002:str", text, style=None if text else '"')


def _represent_nothing(dumper: _Dumper, nothing: None) -> yaml.Node:
    return dumper.represent_scalar("tag:yaml.org,2002:null", "~")


_Dumper.add_representer(str, _represent_text)
_Dumper.add_representer(type(None), _represent_nothing)


def _information(summary: Summary) -> dict[str, object]:
    start = _TIME_OF_NOTHING_NS if summary.start_ns is None else summary.start_ns
    end = start if summary.end_ns is None else summary.end_ns
    extent = {
        "starting_time": {"nanoseconds_since_epoch": start},
        "duration": {"nanoseconds": end - start},
        "message_count": sum(topic.message_count for topic in summary.topics.values()),
    }
    return {
        "version": _VERSION,
        "storage_identifier": "mcap",
        "duration": extent["duration"],
        "starting_time": extent["starting_time"],
        "message_count": extent["message_count"],
        "topics_with_message_count": _topics(summary.topics),
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": [summary.file_name],
        "files": [{"path": summary.file_name, **extent}],
        "custom_data": None,
        "ros_distro": ROS_DISTRO,
    }


def _topics(topics: Mapping[str, RecordedTopic]) -> Sequence[dict[str, object]]:
    return [
        {
            "topic_metadata": {
                "name": name,
                "type": topic.type_name,
                "serialization_format": "cdr",
                "offered_qos_profiles": to_data(topic.qos),
                "type_description_hash": topic.type_hash,
            },
            "message_count": topic.message_count,
        }
        for name, topic in sorted(topics.items())
    ]
