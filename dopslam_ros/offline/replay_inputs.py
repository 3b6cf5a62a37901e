"""What a bag must have to be replayed, looked at before anything is computed from it."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import Any

import yaml

from dopslam_ros.bag import BagReader, deserialize, type_hash
from dopslam_ros.core.pmb import FilterParameters
from dopslam_ros.core.settings.parameters import declarations
from dopslam_ros.messages import topics

_READ = (*topics.INPUTS, topics.FILTER_PARAMETERS)


class ReplayError(ValueError):
    """A bag that cannot be replayed; the message says why."""


def vehicle_prefix(reader: BagReader) -> str:
    """The namespace that the topics were recorded in, with a slash at its end.

    Raises:
        ReplayError: there are no measurement sets, those of several vehicles, or topics whose
            messages are not what they should be.
    """
    prefixes = topics.vehicle_prefixes(reader.topics)
    name = topics.CHANNEL_MEASUREMENTS.name
    found = [prefix + name for prefix in prefixes]
    if not found:
        have = ", ".join(sorted(reader.topics)) or "none"
        damage = f"; {reader.damage}" if reader.damage else ""
        raise ReplayError(
            f"bag '{reader.path}' has no topic .../{name}; its topics: {have}{damage}"
        )
    if len(found) > 1:
        raise ReplayError(
            f"bag '{reader.path}' has several vehicles ({', '.join(found)}): record one per bag"
        )
    for topic in _READ:
        _check_type(reader, prefixes[0] + topic.name, topic.type_name)
    return prefixes[0]


def recorded_settings(
    reader: BagReader, prefix: str, overridden: Collection[str]
) -> dict[str, Any]:
    """What the filter was set to when the bag was recorded; empty if the bag does not say.

    Args:
        reader: the bag.
        prefix: of the topics.
        overridden: names of settings that are given otherwise.

    Raises:
        ReplayError: the settings are damaged, or those of several filters that differ.
    """
    name = prefix + topics.FILTER_PARAMETERS.name
    found = list(_settings(reader, name))
    if found:
        _check_equal(reader, name, found, overridden)
        return found[0]
    if name in reader.topics and reader.topics[name].message_count and not overridden:
        raise ReplayError(
            f"the settings of the filter, {name}, are in the damaged part of '{reader.path}':"
            " give them with --params or --param"
        )
    return {}


def _check_type(reader: BagReader, name: str, expected: str) -> None:
    """Bytes of another type could be taken for numbers that nobody measured."""
    info = reader.topics.get(name)
    if info is None:
        return
    if info.type_name != expected:
        raise ReplayError(
            f"topic {name} of '{reader.path}' has type {info.type_name or 'unknown'}, not"
            f" {expected}"
        )
    if info.type_hash and info.type_hash != type_hash(expected):
        raise ReplayError(
            f"topic {name} of '{reader.path}' was recorded with another definition of {expected}:"
            " use the version of dopslam_msgs that it was recorded with"
        )
    if info.encoding != "cdr":
        raise ReplayError(
            f"topic {name} of '{reader.path}' is encoded as '{info.encoding}', not as 'cdr'"
        )


def _settings(reader: BagReader, name: str) -> Iterator[dict[str, Any]]:
    for message in reader.messages({name}):
        content: Any = deserialize(message.payload, topics.FILTER_PARAMETERS.type_name)
        try:
            settings = yaml.safe_load(content.data)
        except yaml.YAMLError as error:
            raise ReplayError(f"{name} of '{reader.path}' is not YAML: {error}") from error
        if isinstance(settings, dict):
            yield settings


def _check_equal(
    reader: BagReader, name: str, found: list[dict[str, Any]], overridden: Collection[str]
) -> None:
    """Two filters in one bag: it is not guessed which one is meant where they differ."""
    for key in sorted({d.name for d in declarations(FilterParameters)} - set(overridden)):
        values = {repr(settings.get(key)) for settings in found}
        if len(values) > 1:
            raise ReplayError(
                f"bag '{reader.path}' holds the settings of {len(found)} filters, which differ:"
                f" {key} is {' or '.join(sorted(values))}; say which with --param {key}=..."
            )
