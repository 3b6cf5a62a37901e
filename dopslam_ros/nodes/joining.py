"""How nodes wait for each other, so that nothing is lost when they start."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.publisher import Publisher

from dopslam_ros.messages import topics

# How often is looked [s], and how often is said who is waited for at most.
JOIN_PERIOD, SAID_PERIOD = 0.2, 5.0
STEADY = Clock(clock_type=ClockType.STEADY_TIME)


def start_when_joined(
    node: Node, listeners: str, publishers: Iterable[Publisher], start: Callable[[], None]
) -> None:
    """Calls ``start`` once nothing can be lost to the listeners any more.

    Nodes wait for each other in a chain: the filter subscribes only when its own listeners get
    what it publishes, so the simulator, which waits for the filter, waits for those too.

    Args:
        node: who waits.
        listeners: names of nodes, separated by commas; none: start at once.
        publishers: what they listen to.
        start: what to begin.
    """
    wanted, outputs = names(listeners), list(publishers)
    if not wanted:
        start()
        return

    def look() -> None:
        missing = absent(node, wanted, outputs)
        if missing:
            node.get_logger().info(
                f"waiting for {', '.join(missing)}", throttle_duration_sec=SAID_PERIOD
            )
            return
        node.destroy_timer(timer)
        start()

    # The steady clock: where time is simulated it may not run before this node does.
    timer = node.create_timer(JOIN_PERIOD, look, clock=STEADY)


def absent(node: Node, wanted: Sequence[str], publishers: Iterable[Publisher]) -> list[str]:
    """Which of the named nodes of this namespace do not get the node's messages yet.

    All nodes of this package subscribe to the controls, and to them last. Once one is there and
    its subscriptions are matched, nothing that is published is lost to it.
    """

    def subscribers(topic: str) -> list[str]:
        return [
            info.node_name
            for info in node.get_subscriptions_info_by_topic(topic)
            if info.node_namespace == node.get_namespace() and info.node_name in wanted
        ]

    present = subscribers(node.resolve_topic_name(topics.ODOMETRY_CONTROL.name))
    matched = all(p.get_subscription_count() >= len(subscribers(p.topic_name)) for p in publishers)
    return [name for name in wanted if name not in present or not matched]


def names(text: str) -> list[str]:
    """The names in a list separated by commas."""
    return [name.strip() for name in text.split(",") if name.strip()]
