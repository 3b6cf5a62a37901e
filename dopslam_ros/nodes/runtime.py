"""What all nodes share: parameters, quality of service, message classes, diagnostics, shutdown."""

from __future__ import annotations

import importlib
import math
import os
import signal
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import cache
from typing import Any, TypeVar

import rclpy
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.clock import Clock, ClockType
from rclpy.exceptions import (
    InvalidParameterTypeException,
    InvalidParameterValueException,
    NameValidationException,
    ParameterException,
)
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.signals import SignalHandlerOptions

from dopslam_ros.bag import message_class, serialize
from dopslam_ros.bag.qos import OfferedQos
from dopslam_ros.core.models.refusal import Refused
from dopslam_ros.core.settings.parameters import (
    Declaration,
    ParameterError,
    declarations,
    from_mapping,
    to_mapping,
)
from dopslam_ros.messages import topics
from dopslam_ros.messages.conversion import make_diagnostics, read_message
from dopslam_ros.nodes.inbox import Inbox
from dopslam_ros.nodes.losses import Losses

P = TypeVar("P")
DIAGNOSTICS_PERIOD = 1.0
# How often a kind of trouble is written to the log at most [s].
LOG_PERIOD = 5.0
RCLError = rclpy_implementation.RCLError
JOIN_PERIOD = 0.2
STEADY = Clock(clock_type=ClockType.STEADY_TIME)
# The reason that is given for messages that the middleware lost.
LOST = "lost_by_middleware"
# Messages that wait for a subscriber that is busy.
READING_DEPTH = 1000


class StartError(RuntimeError):
    """A node cannot start; the message says why and what to do."""


@cache
def middleware_class(type_name: str) -> Any:
    """rclpy's class of ``package/msg/Name``."""
    package, kind, name = type_name.split("/")
    return getattr(importlib.import_module(f"{package}.{kind}"), name)


def qos_profile(offered: OfferedQos) -> QoSProfile:
    """rclpy's form of a quality of service."""
    # Discovery knows neither history nor depth of others: keep plenty.
    depth = offered.depth or READING_DEPTH
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy(int(offered.reliability)),
        durability=DurabilityPolicy(int(offered.durability)),
    )


def reading_profile(topic: topics.Topic, depth: int = READING_DEPTH) -> QoSProfile:
    """The quality of service to read a topic with.

    As it is offered, but with a deep queue: of a latched topic one message is kept for those who
    come late, while somebody who is there wants to miss none.
    """
    return qos_profile(replace(topic.qos, depth=max(topic.depth, depth)))


class Output:
    """A publisher of messages made by ``bag.message_class``.

    They are serialised here, by the code that the offline replay uses too, and handed to the
    middleware as bytes: what a live run publishes and what its replay writes is then equal byte for
    byte, even where CDR leaves gaps for alignment, which the middleware's own serialiser does not
    clear.
    """

    def __init__(self, publisher: Publisher, type_name: str) -> None:
        self.publisher = publisher
        self._type_name = type_name

    def publish(self, message: Any) -> None:
        """Serialises and sends."""
        self.publisher.publish(serialize(message, self._type_name))


class DopslamNode(Node):
    """A node with checked parameters and diagnostics.

    Attributes:
        problems: how often each kind of input was refused, or other trouble was met.
    """

    def __init__(self, name: str, **options: Any) -> None:
        super().__init__(name, **options)
        self.problems: Counter[str] = Counter()
        self._parameter_sets: list[Any] = []
        self._logged: dict[str, int] = {}
        self._diagnostics = self.output(topics.DIAGNOSTICS)
        self.create_timer(DIAGNOSTICS_PERIOD, self.publish_diagnostics, clock=STEADY)
        self.add_on_set_parameters_callback(self._check_change)

    # --- parameters

    def parameters_of(self, kind: type[P]) -> P:
        """Declares the parameters of a dataclass and returns their resolved values.

        Raises:
            StartError: a value given at start cannot be used.
        """
        values: dict[str, Any] = {}
        for declared in declarations(kind):
            default = declared.default
            start: Any = list(default) if isinstance(default, tuple) else default
            try:
                values[declared.name] = self.declare_parameter(
                    declared.name, start, _descriptor(declared)
                ).value
            except (InvalidParameterTypeException, InvalidParameterValueException) as error:
                given = self._parameter_overrides.get(declared.name)
                raise StartError(_bad_start_value(declared, given, error)) from error
        try:
            parameters = from_mapping(kind, values)
        except ParameterError as error:
            raise StartError(str(error)) from error
        self._parameter_sets.append(parameters)
        self._warn_of_unknown()
        for name, value in to_mapping(parameters).items():
            self.get_logger().info(f"{name}: {value}")
        return parameters

    def parameters_changed(self, parameters: Any) -> None:
        """Called after dynamic parameters changed, with the dataclass of the new values."""

    def _warn_of_unknown(self) -> None:
        """A misspelt name in a YAML file must not be ignored silently."""
        for name in self._parameter_overrides:
            if not self.has_parameter(name) and not name.startswith(("qos_overrides.", "use_sim")):
                self.get_logger().warning(
                    f"parameter '{name}' is given but unknown to this node, and ignored"
                )

    def _check_change(self, changes: list[Parameter]) -> SetParametersResult:
        new = {change.name: change.value for change in changes}
        for number, current in enumerate(self._parameter_sets):
            known = {d.name for d in declarations(type(current))}
            mine = {name: value for name, value in new.items() if name in known}
            if not mine:
                continue
            try:
                changed = from_mapping(type(current), {**to_mapping(current), **mine})
            except ParameterError as error:
                return SetParametersResult(successful=False, reason=str(error))
            self._parameter_sets[number] = changed
            self.parameters_changed(changed)
        return SetParametersResult(successful=True)

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

    def subscribe_last(
        self, topic: topics.Topic, callback: Callable[[Any], None], inbox: Inbox | None = None
    ) -> None:
        """A node's last subscription: who sees this one has seen the others, see ``joined``."""
        self.subscribe(topic, callback, inbox)

    def joined(self, names: Sequence[str], publishers: Iterable[Publisher]) -> list[str]:
        """Which of the named nodes of this namespace do not get our messages yet.

        All nodes of this package subscribe to the controls, and to them last. Once one is there and
        its subscriptions are matched, nothing that is published is lost to it.
        """

        def subscribers(topic: str) -> list[str]:
            return [
                info.node_name
                for info in self.get_subscriptions_info_by_topic(topic)
                if info.node_namespace == self.get_namespace() and info.node_name in names
            ]

        present = subscribers(self.resolve_topic_name(topics.ODOMETRY_CONTROL.name))
        matched = all(
            p.get_subscription_count() >= len(subscribers(p.topic_name)) for p in publishers
        )
        return [name for name in names if name not in present or not matched]

    def start_when_joined(
        self, listeners: str, publishers: Iterable[Publisher], start: Callable[[], None]
    ) -> None:
        """Calls ``start`` once nothing can be lost to the listeners any more.

        Nodes wait for each other in a chain: the filter subscribes only when its own listeners get
        what it publishes, so the simulator, which waits for the filter, waits for those too.

        Args:
            listeners: names of nodes, separated by commas; none: start at once.
            publishers: what they listen to.
            start: what to begin.
        """
        wanted, outputs = names(listeners), list(publishers)
        if not wanted:
            start()
            return

        def look() -> None:
            missing = self.joined(wanted, outputs)
            if missing:
                self.get_logger().info(
                    f"waiting for {', '.join(missing)}", throttle_duration_sec=LOG_PERIOD
                )
                return
            self.destroy_timer(timer)
            start()

        # The steady clock: where time is simulated it may not run before this node does.
        timer = self.create_timer(JOIN_PERIOD, look, clock=STEADY)

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


def stay_on_this_machine() -> None:
    """Nobody outside is found, nor finds us, unless the environment says how far to look."""
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")


def run(create: Callable[[], DopslamNode], arguments: Sequence[str] | None = None) -> int:
    """Runs a node until it is finished or told to stop; returns the exit code.

    Own signal handlers only set a flag, so that Ctrl-C meets the node between two callbacks and
    everything is closed in order. Nothing leaves this machine unless the environment says so.
    """
    stay_on_this_machine()
    try:
        rclpy.init(
            args=list(arguments) if arguments is not None else sys.argv,
            signal_handler_options=SignalHandlerOptions.NO,
        )
        return _spin(create)
    except (StartError, ParameterException, NameValidationException, RCLError) as error:
        print("error:", " ".join(str(error).split()), file=sys.stderr)
        return 2
    finally:
        rclpy.try_shutdown()


def _spin(create: Callable[[], DopslamNode]) -> int:
    stop = False
    executor = SingleThreadedExecutor()

    def ask_to_stop(*_: object) -> None:
        nonlocal stop
        stop = True
        executor.wake()

    # SIGINT even where it is ignored, as in the background: a launch file stops its nodes with it.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, ask_to_stop)
    node: DopslamNode | None = None
    try:
        node = create()
        executor.add_node(node)
        while not stop and not node.finished():
            executor.spin_once(timeout_sec=0.2)
    except ExternalShutdownException:
        pass
    finally:
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)
        if node is not None:
            node.close()
            executor.remove_node(node)
            node.destroy_node()
        executor.shutdown()
    return 0


def _descriptor(declared: Declaration) -> ParameterDescriptor:
    unit = f" [{declared.unit}]" if declared.unit else ""
    descriptor = ParameterDescriptor(
        name=declared.name,
        description=f"{declared.text}{unit}",
        additional_constraints=declared.range_text(),
        read_only=not declared.dynamic,
    )
    bounded = declared.low is not None or declared.high is not None
    low = -math.inf if declared.low is None else declared.low
    high = math.inf if declared.high is None else declared.high
    if bounded and type(declared.default) is float:
        descriptor.floating_point_range = [FloatingPointRange(from_value=low, to_value=high)]
    if bounded and type(declared.default) is int:
        most = 2**62
        descriptor.integer_range = [
            IntegerRange(
                from_value=-most if math.isinf(low) else int(low),
                to_value=most if math.isinf(high) else int(high),
                step=1,
            )
        ]
    return descriptor


def _bad_start_value(declared: Declaration, given: Any, error: Exception) -> str:
    """Why a value given at start was refused, in the words of the declaration."""
    if given is not None:
        try:
            declared.check(given.value)
        except ParameterError as reason:
            return str(reason)
        value = given.value
        if isinstance(value, int) and isinstance(declared.default, float):
            return f"parameter '{declared.name}' = {value}: write {value}.0"
        if isinstance(value, Sequence) and all(isinstance(item, int) for item in value):
            decimal = [float(item) for item in value]
            return f"parameter '{declared.name}' = {list(value)}: write {decimal}"
    return f"parameter '{declared.name}': {error}"


def serve(node_type: Callable[[], DopslamNode]) -> None:
    """Entry point of an executable."""
    raise SystemExit(run(node_type))


def names(text: str) -> list[str]:
    """The names in a list separated by commas."""
    return [name.strip() for name in text.split(",") if name.strip()]
