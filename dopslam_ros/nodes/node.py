"""What all nodes share: parameters, topics, what was refused, diagnostics."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any, TypeVar

from rclpy.node import Node
from rclpy.qos_overriding_options import QoSOverridingOptions

from dopslam_ros.bag import message_class
from dopslam_ros.core.models.refusal import Refused
from dopslam_ros.core.settings.parameters import to_mapping
from dopslam_ros.messages import topics
from dopslam_ros.messages.common import read_message
from dopslam_ros.messages.diagnostics import make_diagnostics
from dopslam_ros.nodes.errors import StartError
from dopslam_ros.nodes.inbox import Inbox
from dopslam_ros.nodes.joining import STEADY
from dopslam_ros.nodes.losses import Losses
from dopslam_ros.nodes.middleware import Output, middleware_class, qos_profile, reading_profile
from dopslam_ros.nodes.node_parameters import Changes, declared, unknown

P = TypeVar("P")
DIAGNOSTICS_PERIOD = 1.0
# How often a kind of problem is written to the log at most [s].
LOG_PERIOD = 5.0
# The reason that is given for messages that the middleware lost.
LOST = "lost_by_middleware"


class DopslamNode(Node):
    """A node with checked parameters and diagnostics.

    Attributes:
        problems: how often each kind of input was refused, or another problem was met.
    """

    def __init__(self, name: str, **options: Any) -> None:
        super().__init__(name, **options)
        self.problems: Counter[str] = Counter()
        self._changes = Changes(self.parameters_changed)
        self._logged: dict[str, int] = {}
        self._diagnostics = self.output(topics.DIAGNOSTICS)
        self.create_timer(DIAGNOSTICS_PERIOD, self.publish_diagnostics, clock=STEADY)
        self.add_on_set_parameters_callback(self._changes.check)

    # --- parameters

    def parameters_of(self, kind: type[P]) -> P:
        """Declares the parameters of a dataclass and returns their resolved values.

        Raises:
            StartError: a value given at start cannot be used.
        """
        parameters = declared(self, kind)
        self._changes.add(parameters)
        for name in unknown(self):
            self.get_logger().warning(
                f"parameter '{name}' is given but unknown to this node, and ignored"
            )
        for name, value in to_mapping(parameters).items():
            self.get_logger().info(f"{name}: {value}")
        return parameters

    def parameters_changed(self, parameters: Any) -> None:
        """Called after dynamic parameters changed, with the dataclass of the new values."""

    # --- topics

    def output(self, topic: topics.Topic) -> Output:
        """A publisher with the topic's quality of service, which parameters may override."""
        try:
            kind = middleware_class(topic.type_name)
        except ModuleNotFoundError as error:
            package = topic.type_name.partition("/")[0]
            remedy = f"apt install ros-jazzy-{package.replace('_', '-')}, or make setup"
            raise StartError(f"the messages of '{package}' are not installed: {remedy}") from error
        publisher = self.create_publisher(
            kind,
            topic.name,
            qos_profile(topic.qos),
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )
        return Output(publisher, topic.type_name)

    def subscribe(
        self,
        topic: topics.Topic,
        callback: Callable[[Any], None],
        inbox: Inbox | None = None,
    ) -> None:
        """A subscription whose callback may raise an error with a ``reason``: it is counted.

        So is what the middleware lost. The bytes are read here, as the offline replay reads them,
        because what the middleware cannot read it drops without a word.

        Args:
            topic: what to read.
            callback: gets the messages.
            inbox: where they wait; None: each is handled as it comes.
        """

        def guarded(payload: bytes) -> None:
            try:
                callback(read_message(payload, topic))
            except Exception as error:  # a node never dies of a message
                self.refuse(topic.name, error)

        kind, qos = middleware_class(topic.type_name), reading_profile(topic)
        options: Any = {"qos_overriding_options": QoSOverridingOptions.with_default_policies()}
        if inbox is not None:
            inbox.listen(kind, topic.name, qos, guarded, **options)
            return
        losses = Losses(self, self.resolve_topic_name(topic.name))

        def came(payload: bytes, about: dict[str, Any]) -> None:
            if missing := losses.before(about["publication_sequence_number"]):
                self.miss(topic.name, missing)
            guarded(payload)

        node: Any = self  # rclpy's types know no callback that asks about its message
        node.create_subscription(kind, topic.name, came, qos, raw=True, **options)

    def refuse(self, source: str, error: Exception, count: int = 1) -> None:
        """Counts inputs that were refused and logs it, each reason at most every few seconds."""
        reason = getattr(error, "reason", type(error).__name__)
        self.problems[reason] += count
        now = self.get_clock().now().nanoseconds
        if reason in self._logged and 0 <= now - self._logged[reason] < LOG_PERIOD * 1e9:
            return
        self._logged[reason] = now
        self.get_logger().warning(
            f"{source}: refused ({reason}, {self.problems[reason]} so far): {error}"
        )

    def miss(self, topic: str, count: int) -> None:
        """Counts and logs what the middleware lost."""
        text = f"{count} messages are missing: send fewer, or give the node more processor"
        self.refuse(topic, Refused(LOST, text), count)

    # --- diagnostics

    def health(self) -> tuple[int, str, list[tuple[str, Any]]]:
        """Level (0 OK, 1 WARN, 2 ERROR), summary, values; nodes add their own."""
        return 0, "running", []

    def publish_diagnostics(self) -> None:
        """One status with everything that was counted."""
        level, summary, values = self.health()
        if self.problems:
            level = max(level, 1)
            summary += f", {sum(self.problems.values())} problems"
        values = values + [(f"problem.{name}", n) for name, n in sorted(self.problems.items())]
        now = self.get_clock().now().nanoseconds
        self._diagnostics.publish(
            make_diagnostics(
                message_class, now, self.get_fully_qualified_name(), level, summary, values
            )
        )

    # --- end

    def finished(self) -> bool:
        """Whether the node has nothing more to do."""
        return False

    def close(self) -> None:
        """Called once before the node is destroyed: finish what is begun."""
