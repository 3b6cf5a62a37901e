"""Filters a bag offline: the same core as the live nodes, no middleware, as fast as it can."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import yaml

from dopslam_ros.bag import BagMessage, BagReader, BagWriter, message_class, serialize
from dopslam_ros.core.linalg.arrays import FloatArray
from dopslam_ros.core.models.refusal import Refused
from dopslam_ros.core.pcrb.bounds import Bounds
from dopslam_ros.core.pmb import FilterParameters
from dopslam_ros.core.session.bounding import BoundsOutput, BoundsSession, WorldState
from dopslam_ros.core.session.checkpoint import BEFORE_ALL, Checkpoint, CheckpointError
from dopslam_ros.core.session.events import LOAD_MAP, Event
from dopslam_ros.core.session.filtering import FilterOutput, FilterSession
from dopslam_ros.core.settings.layout import LandmarkType
from dopslam_ros.core.settings.parameters import declarations, from_mapping
from dopslam_ros.messages import topics
from dopslam_ros.messages.conversion import (
    Frames,
    MapArrays,
    make_bounds,
    make_text,
    read_control,
    read_map,
    read_measurements,
    read_message,
    read_ue_state,
    stamp_ns,
)
from dopslam_ros.messages.events import make_event, recorded_events
from dopslam_ros.messages.filter_output import DrawingParameters, FilterMessages
from dopslam_ros.offline.evaluation import StepRecord, judge_step, summarise
from dopslam_ros.offline.replay_inputs import recorded_settings, vehicle_prefix
from dopslam_ros.simulation.matched import bounds_parameters_for
from dopslam_ros.system.stopping import until_stopped


@dataclass
class Replay:
    """What came out of a bag.

    Attributes:
        parameters: what the filter was set to.
        outputs: of the filter, in order.
        bounds: by stamp [ns].
        truth: (4,) true states by stamp [ns].
        true_map: the true landmarks, if the bag has them.
        problems: how often each kind of input was refused, or other trouble was met.
        damage: what of the bag could not be read, in a sentence.
        known_map: the map at the end.
    """

    parameters: FilterParameters
    outputs: list[FilterOutput] = field(default_factory=list)
    bounds: dict[int, BoundsOutput] = field(default_factory=dict)
    truth: dict[int, FloatArray] = field(default_factory=dict)
    true_map: MapArrays | None = None
    problems: Counter[str] = field(default_factory=Counter)
    damage: str | None = None
    known_map: Checkpoint | None = None

    def records(self) -> list[StepRecord]:
        """Each step judged against the truth, as far as the bag has it."""
        vas = sps = None
        if self.true_map is not None:
            vas = self.true_map.of_type(LandmarkType.VA)
            sps = self.true_map.of_type(LandmarkType.SP)
        return [
            judge_step(
                output.state.ue_mean,
                output.state.ue_covariance,
                output.landmarks,
                self.truth.get(output.stamp_ns),
                vas,
                sps,
                self._bound_at(output.stamp_ns),
                seconds=output.step_seconds,
            )
            for output in self.outputs
        ]

    def summary(self) -> dict[str, Any]:
        """How good it was, and what was wrong with the bag, as ``--json`` has it."""
        summary = summarise(self.records())
        summary["problems"] = dict(sorted(self.problems.items()))
        if self.damage:
            summary["damage"] = self.damage
        return summary

    def _bound_at(self, stamp: int) -> Bounds | None:
        """With the components that the filter used: without Doppler if it used none."""
        bound = self.bounds.get(stamp)
        return None if bound is None else bound.with_doppler


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
    run = _Run(parameters, frames, drawing, prefix, has_truth, writer)
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


class _Run:
    """A replay under way."""

    def __init__(
        self,
        parameters: FilterParameters,
        frames: Frames,
        drawing: DrawingParameters,
        prefix: str,
        has_truth: bool,
        writer: BagWriter | None,
    ) -> None:
        self.result = Replay(parameters)
        self._has_truth = has_truth
        self._filter = FilterSession(parameters)
        self._bounds = BoundsSession(bounds_parameters_for(parameters))
        self._messages = FilterMessages(
            message_class, parameters.bs, parameters.ue_height, frames, drawing
        )
        self._frames = frames
        self._prefix = prefix
        self._writer = writer
        self._time_ns = 0
        self._pending_states: list[tuple[int, FloatArray]] = []

    def feed(self, message: BagMessage, topic: topics.Topic) -> None:
        """One input; trouble with it is counted."""
        self._time_ns = message.log_time_ns
        if self._writer is not None:
            self._writer.write(
                message.topic, message.payload, message.log_time_ns, message.publish_time_ns
            )
        if message.type_name != topic.type_name:  # somebody else published there too
            self.result.problems["wrong_type"] += 1
            return
        try:
            self._dispatch(topic, read_message(message.payload, topic))
        except Refused as error:
            self.result.problems[error.reason] += 1
        except (ValueError, OverflowError, ArithmeticError) as error:
            self.result.problems[type(error).__name__] += 1

    def schedule(self, events: Sequence[Event], start_map: Checkpoint | None) -> None:
        """What is to be done to the filter; an event that cannot be done again is counted."""
        if self._writer is not None and (events or start_map is not None):
            topic = topics.FILTER_EVENTS
            self._writer.add_topic(self._prefix + topic.name, topic.type_name, qos=[topic.qos])
        if start_map is not None:
            events = [e for e in events if e.after_ns != BEFORE_ALL]
            self._happen(Event(LOAD_MAP, BEFORE_ALL, saved=start_map))
        for event in events:
            try:
                self._happen(event)
            except CheckpointError:
                self.result.problems["event_refused"] += 1

    def _happen(self, event: Event) -> None:
        self._filter.schedule(event)
        if self._writer is not None:
            self._write(topics.FILTER_EVENTS, make_event(message_class, event))

    def finish(self) -> None:
        """The end of the inputs."""
        self._filtered(self._filter.end())
        self._bounded(self._bounds.end())
        self.result.known_map = self._filter.known_map()
        self.result.problems.update(self._filter.problems)

    def write_parameters(
        self,
        reader: BagReader,
        settings: Mapping[str, object],
        overrides: Mapping[str, object],
    ) -> None:
        """The settings of this run, so that the new bag can be replayed in its turn."""
        values = {**settings, **overrides}
        plain = {k: list(v) if isinstance(v, tuple) else v for k, v in values.items()}
        text = yaml.safe_dump(plain)
        self._time_ns = reader.start_time_ns or 0
        self._write(topics.FILTER_PARAMETERS, make_text(message_class, text))

    def _dispatch(self, topic: topics.Topic, content: Any) -> None:
        if topic == topics.TRUTH_LANDMARKS:
            self.result.true_map = read_map(content)
            waiting, self._pending_states = self._pending_states, []
            for stamp, state in waiting:
                self._add_truth(stamp, state)
            return
        stamp = stamp_ns(content.header)
        if topic == topics.TRUTH_UE:
            self._add_truth(stamp, read_ue_state(content)[0])
        elif topic == topics.ODOMETRY_CONTROL:
            speed, turn_rate = read_control(content)
            self._filtered(self._filter.add_control(stamp, speed, turn_rate))
            self._bounded(self._bounds.add_control(stamp, speed, turn_rate))
        else:
            self._filtered(self._filter.add_measurements(stamp, read_measurements(content)))

    def _add_truth(self, stamp: int, state: FloatArray) -> None:
        self.result.truth[stamp] = state
        if self.result.true_map is None:
            self._pending_states.append((stamp, state))
            return
        self._bounded(self._bounds.add_world(stamp, self.result.true_map.at(state)))

    def _filtered(self, outputs: Iterable[FilterOutput]) -> None:
        for output in outputs:
            self.result.outputs.append(output)
            if not self._has_truth:
                found = output.landmarks
                world = WorldState(output.state.ue_mean, found.ids, found.types, found.positions)
                self._bounded(self._bounds.add_world(output.stamp_ns, world))
            if self._writer is not None:
                for topic, message in self._messages.of(output):
                    self._write(topic, message)

    def _bounded(self, outputs: Iterable[BoundsOutput]) -> None:
        for output in outputs:
            self.result.bounds[output.stamp_ns] = output
            if self._writer is not None:
                self._write(topics.BOUNDS, make_bounds(message_class, output, self._frames))

    def _write(self, topic: topics.Topic, message: Any) -> None:
        assert self._writer is not None
        payload = serialize(message, topic.type_name)
        self._writer.write(self._prefix + topic.name, payload, self._time_ns)


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
