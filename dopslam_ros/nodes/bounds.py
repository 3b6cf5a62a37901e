"""The bounds node: how good any estimator could be, at the truth or at the estimate."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from dopslam_ros.bag import message_class
from dopslam_ros.core.linalg.arrays import FloatArray
from dopslam_ros.core.session.bounding import BoundsOutput, BoundsSession
from dopslam_ros.core.settings.bounding import BoundsParameters
from dopslam_ros.core.settings.parameters import parameter
from dopslam_ros.messages import topics
from dopslam_ros.messages.common import Frames, stamp_ns
from dopslam_ros.messages.inputs import read_control
from dopslam_ros.messages.states import MapArrays, make_bounds, read_map, read_ue_state
from dopslam_ros.nodes.joining import start_when_joined
from dopslam_ros.nodes.node import DopslamNode
from dopslam_ros.nodes.running import serve
from dopslam_ros.simulation.warmup import warm_up_bounds

# States and maps that wait for their counterpart; beyond this the oldest are given up.
MOST_WAITING = 1000


@dataclass(frozen=True)
class BoundsNodeParameters(BoundsParameters):
    """The settings of the bounds and the node's own."""

    map_frame: str = parameter("map", "Frame that the bounds are stamped with.")
    wait_for_nodes: str = parameter(
        "", "Names of nodes, separated by commas, that must get the bounds before any is made."
    )


class BoundsNode(DopslamNode):
    """Runs a BoundsSession."""

    def __init__(self, **options: Any) -> None:
        super().__init__("bounds", **options)
        p = self.parameters_of(BoundsNodeParameters)
        self._session = BoundsSession(p)
        warm_up_bounds(p)  # the first state is not to wait for a compiler
        self._frames = Frames(map=p.map_frame)
        self._source = p.source
        self._true_map: MapArrays | None = None
        self._maps: dict[int, MapArrays] = {}
        self._states: dict[int, FloatArray] = {}
        self._published = 0
        self._bounds = self.output(topics.BOUNDS)
        start_when_joined(self, p.wait_for_nodes, [self._bounds.publisher], self._start)

    def _start(self) -> None:
        if self._source != "estimate":
            self.subscribe(topics.TRUTH_LANDMARKS, self._on_true_map)
            self.subscribe(topics.TRUTH_UE, lambda m: self._on_state("truth", m))
        if self._source != "truth":
            self.subscribe(topics.LANDMARKS, self._on_map)
            self.subscribe(topics.UE_STATE, lambda m: self._on_state("estimate", m))
        # The controls last: see nodes.joining.
        self.subscribe(topics.ODOMETRY_CONTROL, self._on_control)
        self.get_logger().info("ready")

    def _on_control(self, message: Any) -> None:
        control = read_control(message)
        self._publish(
            self._session.add_control(stamp_ns(message.header), control.speed, control.turn_rate)
        )

    def _on_true_map(self, message: Any) -> None:
        self._true_map = read_map(message)
        self._evaluate()

    def _on_map(self, message: Any) -> None:
        if self._source != "truth":
            self._maps[stamp_ns(message.header)] = read_map(message)
            self._evaluate()

    def _on_state(self, source: str, message: Any) -> None:
        if self._source == "auto":
            # Decided once, at the first state: a truth that somebody publishes is preferred.
            self._source = "truth" if self.count_publishers(topics.TRUTH_UE.name) else "estimate"
            if self._source == "truth":
                self._maps.clear()
            self.get_logger().info(f"evaluating the bounds at the {self._source}")
        if source == self._source:
            self._states[stamp_ns(message.header)], _ = read_ue_state(message)
            self._evaluate()

    def _evaluate(self) -> None:
        """Every state that has its map: the true one, or the estimate's of the same stamp."""
        for stamp in sorted(self._states):
            world = self._true_map if self._source == "truth" else self._maps.pop(stamp, None)
            if world is not None:
                ue = self._states.pop(stamp)
                self._publish(self._session.add_world(stamp, world.at(ue)))
        for waiting in (self._states, self._maps):
            for stamp in sorted(waiting)[:-MOST_WAITING]:
                del waiting[stamp]
                self.problems["state_without_map"] += 1

    def _publish(self, outputs: Iterable[BoundsOutput]) -> None:
        for output in outputs:
            self._published += 1
            self._bounds.publish(make_bounds(message_class, output, self._frames))

    def health(self) -> tuple[int, str, list[tuple[str, Any]]]:
        self.problems.update(self._session.problems)
        self._session.problems.clear()
        return (
            0,
            f"{self._published} bounds published at the {self._source}",
            [("bounds_published", self._published), ("states_waiting", self._session.pending)],
        )

    def close(self) -> None:
        self._publish(self._session.end())


def main() -> None:
    """ros2 run dopslam_ros bounds."""
    serve(BoundsNode)


if __name__ == "__main__":
    main()
