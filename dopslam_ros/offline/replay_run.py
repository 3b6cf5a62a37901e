"""A replay under way: what each message of a bag leads to."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import yaml

from dopslam_ros.bag import BagMessage, BagReader, BagWriter, message_class, serialize
from dopslam_ros.core.linalg.arrays import FloatArray
from dopslam_ros.core.models.refusal import Refused
from dopslam_ros.core.pmb import FilterParameters
from dopslam_ros.core.session.bounding import BoundsOutput, BoundsSession, WorldState
from dopslam_ros.core.session.checkpoint import BEFORE_ALL, Checkpoint, CheckpointError
from dopslam_ros.core.session.events import LOAD_MAP, Event
from dopslam_ros.core.session.filtering import FilterSession
from dopslam_ros.core.session.output import FilterOutput
from dopslam_ros.messages import topics
from dopslam_ros.messages.common import Frames, make_text, read_message, stamp_ns
from dopslam_ros.messages.events import make_event
from dopslam_ros.messages.filter_output import DrawingParameters, FilterMessages
from dopslam_ros.messages.inputs import read_control, read_measurements
from dopslam_ros.messages.states import make_bounds, read_map, read_ue_state
from dopslam_ros.offline.replay_result import Replay
from dopslam_ros.simulation.matched import bounds_parameters_for


class ReplayRun:
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
        """One input; a problem with it is counted."""
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
