"""The simulator node: publishes the measurement sets, controls and truth of a scenario."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from rclpy.duration import Duration
from rclpy.timer import Timer

from dopslam_ros.core.settings.parameters import parameter
from dopslam_ros.messages import topics
from dopslam_ros.messages.common import Frames
from dopslam_ros.nodes.errors import StartError
from dopslam_ros.nodes.joining import start_when_joined
from dopslam_ros.nodes.node import DopslamNode
from dopslam_ros.nodes.running import serve
from dopslam_ros.simulation.recording import Message, map_message, snapshot_messages
from dopslam_ros.simulation.scenario import START_NS, ScenarioError, load_scenario
from dopslam_ros.simulation.simulator import simulate


@dataclass(frozen=True)
class SimulatorParameters:
    """Settings of the simulator; the scene itself is in the scenario file."""

    scenario: str = parameter(
        "paper", "Name of a scene that comes with the package, or path of a YAML file."
    )
    seed: int = parameter(-1, "Seed of the run; -1: the scenario's.", low=-1)
    rate: float = parameter(
        1.0, "How many times faster than real time.", low=1e-3, high=1e6, dynamic=True
    )
    start_time: float = parameter(
        0.0, "Stamp of the first snapshot; 0: the time of the clock.", unit="s", low=0.0
    )
    wait_for_nodes: str = parameter(
        "filter", "Names of nodes, separated by commas, to wait for before the first snapshot."
    )
    exit_when_done: bool = parameter(True, "Whether to end after the last snapshot.")
    map_frame: str = parameter("map", "Frame of the truth.")
    base_frame: str = parameter("base_link", "Frame of the vehicle.")


class SimulatorNode(DopslamNode):
    """Publishes one run."""

    def __init__(self, **options: Any) -> None:
        super().__init__("simulator", **options)
        p = self.parameters_of(SimulatorParameters)
        try:
            self._scenario = load_scenario(p.scenario)
        except ScenarioError as error:
            raise StartError(str(error)) from error
        seed = self._scenario.seed if p.seed < 0 else p.seed
        self._run = simulate(self._scenario, np.random.default_rng(seed))
        self._frames = Frames(p.map_frame, p.base_frame)
        self._exit = p.exit_when_done
        self._start_time = p.start_time
        self._offset_ns = 0
        self._sent = 0
        self._done = False
        self._outputs = {topic.name: self.output(topic) for topic in topics.INPUTS}
        self._rate = p.rate
        self._timer: Timer | None = None
        self.get_logger().info(
            f"ready: scene '{self._scenario.name}', {self._scenario.steps} snapshots, seed {seed}"
        )
        publishers = [output.publisher for output in self._outputs.values()]
        start_when_joined(self, p.wait_for_nodes, publishers, self._start)

    def parameters_changed(self, parameters: Any) -> None:
        self._rate = parameters.rate
        if self._sent and not self._done:
            self._restart_timer()

    def finished(self) -> bool:
        return self._done and self._exit

    def close(self) -> None:
        for output in self._outputs.values():
            output.publisher.wait_for_all_acked(Duration(seconds=2.0))

    def health(self) -> tuple[int, str, list[tuple[str, Any]]]:
        steps = self._scenario.steps
        return 0, f"{self._sent} of {steps} snapshots sent", [("snapshots_sent", self._sent)]

    def _start(self) -> None:
        now = self.get_clock().now().nanoseconds
        start = round(self._start_time * 1e9) if self._start_time > 0.0 else now
        self._offset_ns = start - START_NS
        self._send_messages([map_message(self._scenario, start, self._frames)])
        self._restart_timer()

    def _restart_timer(self) -> None:
        self._stop_timer()
        self._timer = self.create_timer(self._scenario.period / self._rate, self._send)

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self.destroy_timer(self._timer)
            self._timer = None

    def _send(self) -> None:
        snapshot = next(self._run, None)
        if snapshot is None:
            self._done = True
            self._stop_timer()
            self.get_logger().info(f"done: {self._sent} snapshots sent")
            return
        time_ns = snapshot.stamp_ns + self._offset_ns
        self._send_messages(snapshot_messages(snapshot, time_ns, self._frames))
        self._sent += 1

    def _send_messages(self, messages: Iterable[Message]) -> None:
        for topic, message in messages:
            self._outputs[topic.name].publish(message)


def main() -> None:
    """ros2 run dopslam_ros simulator."""
    serve(SimulatorNode)


if __name__ == "__main__":
    main()
