"""Filters a bag offline: the same core as the live nodes, no middleware, as fast as it can."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

from dopslam_ros.bag import BagMessage, BagReader, BagWriter
from dopslam_ros.core.pmb import FilterParameters
from dopslam_ros.core.session.checkpoint import Checkpoint
from dopslam_ros.core.settings.parameters import declarations, from_mapping
from dopslam_ros.messages import topics
from dopslam_ros.messages.common import Frames
from dopslam_ros.messages.events import recorded_events
from dopslam_ros.messages.filter_output import DrawingParameters
from dopslam_ros.offline.replay_inputs import recorded_settings, vehicle_prefix
from dopslam_ros.offline.replay_result import Replay
from dopslam_ros.offline.replay_run import ReplayRun
from dopslam_ros.system.stopping import until_stopped


def replay(
    reader: BagReader,
    overrides: Mapping[str, object] | None = None,
    writer: BagWriter | None = None,
    progress: Callable[[Iterable[BagMessage]], Iterable[BagMessage]] = iter,
    start_map: Checkpoint | None = None,
) -> Replay:
    """Runs the filter and the bounds over the inputs in a bag.

    The bounds are evaluated at the truth if the bag has it, else at the estimate.

    The filter is set as it was when the bag was recorded, if the bag says so, changed by
    ``overrides``. The order of the messages within each topic counts, not how topics interleave.
    What services did to it while it was recorded (see ``filter_events``) is done again. Ctrl-C ends
    the replay if it is within a Stop.

    Args:
        reader: the bag.
        overrides: filter parameters by name.
        writer: gets the inputs as they are and the outputs anew, or None.
        progress: wraps the iteration over the messages.
        start_map: a map to start with, in the place of the one the bag was recorded with.

    Raises:
        ReplayError: the bag has no measurement sets, topics of another type, several vehicles, or
            the settings of several filters that differ.
        ParameterError: a parameter is unknown or its value unusable.
        CheckpointError: the map does not go with the parameters.
        BagError: the bag cannot be read or written.
    """
    prefix = vehicle_prefix(reader)
    names = {prefix + topic.name: topic for topic in topics.INPUTS}
    settings = recorded_settings(reader, prefix, (overrides or {}).keys())
    frames = Frames(
        str(settings.get("map_frame", Frames.map)), str(settings.get("base_frame", Frames.base))
    )
    drawing = from_mapping(DrawingParameters, _those_of(DrawingParameters, settings))
    parameters = from_mapping(
        FilterParameters, {**_those_of(FilterParameters, settings), **(overrides or {})}
    )

    has_truth = all(
        prefix + topic.name in reader.topics and reader.topics[prefix + topic.name].message_count
        for topic in (topics.TRUTH_UE, topics.TRUTH_LANDMARKS)
    )
    run = ReplayRun(parameters, frames, drawing, prefix, has_truth, writer)
    if writer is not None:
        _announce(reader, writer, prefix)
        run.write_parameters(reader, settings, overrides or {})
    run.schedule(recorded_events(reader, prefix, run.result.problems), start_map)
    for message in until_stopped(progress(reader.messages(set(names)))):
        run.feed(message, names[message.topic])
    run.finish()
    run.result.damage = reader.damage
    return run.result


def recorded_parameters(reader: BagReader) -> FilterParameters:
    """What the filter was set to when the bag was recorded; defaults where the bag does not say.

    Raises:
        ReplayError: the bag has no measurement sets.
        BagError: the bag cannot be read.
    """
    settings = recorded_settings(reader, vehicle_prefix(reader), ())
    return from_mapping(FilterParameters, _those_of(FilterParameters, settings))


def _those_of(parameters: type[Any], settings: Mapping[str, Any]) -> dict[str, Any]:
    """The settings that belong to some parameters."""
    known = {declared.name for declared in declarations(parameters)}
    return {name: value for name, value in settings.items() if name in known}


def _announce(reader: BagReader, writer: BagWriter, prefix: str) -> None:
    for name, info in reader.topics.items():
        if name in {prefix + topic.name for topic in topics.INPUTS}:
            writer.copy_topic(name, info)
    for topic in topics.OUTPUTS:
        writer.add_topic(prefix + topic.name, topic.type_name, qos=[topic.qos])
