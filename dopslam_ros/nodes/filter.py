"""The filter node: measurement sets and controls in; vehicle, map and markers out."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from dopslam_ros.bag import message_class
from dopslam_ros.core.models.refusal import Refused
from dopslam_ros.core.monitoring.health import Level
from dopslam_ros.core.session.filtering import FilterSession
from dopslam_ros.core.session.output import FilterOutput
from dopslam_ros.core.settings.parameters import commented_yaml
from dopslam_ros.messages import topics
from dopslam_ros.messages.common import Frames, make_text, stamp_ns
from dopslam_ros.messages.filter_output import FilterMessages
from dopslam_ros.messages.inputs import read_control, read_measurements
from dopslam_ros.nodes.filter_control import FilterControl
from dopslam_ros.nodes.filter_parameters import FilterNodeParameters
from dopslam_ros.nodes.inbox import Inbox
from dopslam_ros.nodes.joining import start_when_joined
from dopslam_ros.nodes.node import DopslamNode
from dopslam_ros.nodes.running import serve
from dopslam_ros.simulation.warmup import warm_up_filter


class FilterNode(DopslamNode):
    """Runs a FilterSession."""

    def __init__(self, **options: Any) -> None:
        super().__init__("filter", **options)
        p = self.parameters_of(FilterNodeParameters)
        self._session = FilterSession(p)
        warm_up_filter(p)  # the first set is not to wait for a compiler
        frames = Frames(p.map_frame, p.base_frame)
        self._messages = FilterMessages(
            message_class, np.array(p.bs_position), p.ue_height, frames, p, p.publish_tf
        )
        wanted = (*topics.OUTPUTS, *((topics.TF,) if p.publish_tf else ()))
        self._outputs = {t.name: self.output(t) for t in wanted if t != topics.BOUNDS}
        self._outputs[topics.FILTER_PARAMETERS.name].publish(
            make_text(message_class, commented_yaml(p))
        )
        self._control = FilterControl(self, self._session, p)
        self._step_seconds: list[float] = []
        self._level = Level.OK
        self._sets = 0
        self._idle = False
        self._most_waiting = p.most_waiting
        self._inbox = Inbox(self, p.most_waiting, self._on_overload, self.miss)
        publishers = [output.publisher for output in self._outputs.values()]
        start_when_joined(self, p.wait_for_nodes, publishers, self._start)

    def _start(self) -> None:
        self.subscribe(topics.CHANNEL_MEASUREMENTS, self._on_measurements, self._inbox)
        # The controls last: see nodes.joining.
        self.subscribe(topics.ODOMETRY_CONTROL, self._on_control, self._inbox)
        self.create_timer(self._session.parameters.control_wait, self._on_silence)
        self.get_logger().info("ready")

    def _on_control(self, message: Any) -> None:
        self._idle = False
        control = read_control(message)
        self._publish(
            self._session.add_control(stamp_ns(message.header), control.speed, control.turn_rate)
        )

    def _on_measurements(self, message: Any) -> None:
        self._idle = False
        measurements = read_measurements(message)
        self._publish(self._session.add_measurements(stamp_ns(message.header), measurements))

    def _on_overload(self, topic: str, count: int) -> None:
        of_sets = topic == topics.CHANNEL_MEASUREMENTS.name
        reason = "overload_dropped" if of_sets else "overload_dropped_control"
        text = f"more than {self._most_waiting} wait: send fewer, or give the node more processor"
        self.refuse(topic, Refused(reason, text), count)

    def _on_silence(self) -> None:
        """Nothing arrived for a whole period: what waits will wait in vain."""
        if self._idle and self._session.pending:
            self._publish(self._session.flush())
        self._idle = True

    def _publish(self, outputs: Iterable[FilterOutput]) -> None:
        for output in outputs:
            self._sets += 1
            self._step_seconds = [*self._step_seconds[-99:], output.step_seconds]
            for topic, message in self._messages.of(output):
                self._outputs[topic.name].publish(message)
            self._control.offer_snapshot()

    def health(self) -> tuple[int, str, list[tuple[str, Any]]]:
        self.problems.update(self._session.problems)
        self._session.problems.clear()
        state = self._session.state
        smallest = float(np.linalg.eigvalsh(state.ue_covariance)[0])
        steps = np.array(self._step_seconds or [0.0]) * 1e3
        health = self._session.health
        if health.level != self._level:
            self.get_logger().warning(f"{health.level.name}: {health.reason}")
            self._level = health.level
        return (
            int(health.level),
            f"{self._sets} sets processed, {health.level.name}: {health.reason}",
            [
                ("sets_processed", self._sets),
                (
                    "sets_waiting",
                    self._session.pending + self._inbox.waiting(topics.CHANNEL_MEASUREMENTS.name),
                ),
                ("landmarks", len(state.landmark_ids)),
                ("step_ms_median", f"{np.median(steps):.3f}"),
                ("step_ms_max", f"{steps.max():.3f}"),
                ("smallest_eigenvalue", f"{smallest:.3e}"),
                *health.figures,
                *self._control.health(),
            ],
        )

    def close(self) -> None:
        self._inbox.empty()
        self._publish(self._session.end())
        self._control.close()


def main() -> None:
    """ros2 run dopslam_ros filter."""
    serve(FilterNode)


if __name__ == "__main__":
    main()
