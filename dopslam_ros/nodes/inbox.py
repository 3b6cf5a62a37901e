"""What waits for a node that cannot keep up: queues of stated length, and a count of what is lost.

The middleware's own queue drops without a word; what it lost is found out: see ``losses``.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from itertools import count
from typing import Any

from rclpy.node import Node
from rclpy.qos import QoSProfile

from dopslam_ros.nodes.losses import Losses

Handler = Callable[[bytes], None]
Missed = Callable[[str, int], None]
# After so long [s] the node's services and timers get their turn.
LONGEST_TURN = 0.01
# While messages are handled it is looked so often [s] what has come.
LOOK_PERIOD = 0.001


class _Queue:
    """The messages of one subscription that wait, each with its turn."""

    def __init__(self, topic: str, handler: Handler, losses: Losses) -> None:
        self.topic = topic
        self.handler = handler
        self.losses = losses
        self.subscription: Any = None
        self.waiting: deque[tuple[int, bytes]] = deque()


class Inbox:
    """Messages of several topics in the order they arrived; of each topic only so many wait.

    The oldest are dropped: what comes last says most about the present. That goes for every topic:
    one that nobody limits would take all of the node's time from the others. All that has come is
    taken at once, because being reactivated costs more than most messages do.

    Args:
        node: whose messages they are.
        most: messages of a topic that may wait.
        dropped: called with the topic's name and how many of its messages were dropped.
        lost: called with the topic's name and how many of its messages the middleware lost.
    """

    def __init__(self, node: Node, most: int, dropped: Missed, lost: Missed) -> None:
        self._node: Any = node  # rclpy's types know no callback that asks about its message
        self._most = most
        self._dropped = dropped
        self._lost = lost
        self._turns = count()
        self._queues: dict[str, _Queue] = {}
        self._wake: Any = node.create_guard_condition(self._turn)

    def waiting(self, topic: str) -> int:
        """How many messages of a topic wait."""
        return len(self._queues[topic].waiting) if topic in self._queues else 0

    def listen(
        self, kind: Any, topic: str, qos: QoSProfile, handler: Handler, **options: Any
    ) -> None:
        """Subscribes to a topic; the handler gets the bytes of each message in its turn.

        Args:
            kind: rclpy's class of the messages.
            topic: the name that it shall have here, too.
            qos: how to read it.
            handler: must not raise.
            options: of the subscription.
        """
        losses = Losses(self._node, self._node.resolve_topic_name(topic))
        queue = self._queues[topic] = _Queue(topic, handler, losses)

        def came(payload: bytes, about: dict[str, Any]) -> None:
            self._append(queue, payload, about)
            self._turn()

        queue.subscription = self._node.create_subscription(
            kind, topic, came, qos, raw=True, **options
        )

    def empty(self) -> None:
        """Handles all that has come."""
        self._take_in()
        while self._handle():
            pass

    def _turn(self) -> None:
        """Handles what has come, and what comes meanwhile, for a while."""
        now = time.monotonic()
        end, look = now + LONGEST_TURN, now
        while now < end:
            if now >= look or not any(queue.waiting for queue in self._queues.values()):
                self._take_in()
                look = now + LOOK_PERIOD
            if not self._handle():
                return
            now = time.monotonic()
        self._wake.trigger()

    def _take_in(self) -> None:
        came: list[tuple[int, _Queue, bytes, dict[str, Any]]] = []
        for queue in self._queues.values():
            handle = queue.subscription.handle
            with handle:
                while (taken := handle.take_message(bytes, True)) is not None:
                    payload, about = taken
                    came.append((about["received_timestamp"], queue, payload, about))
        for _, queue, payload, about in sorted(came, key=lambda one: one[0]):
            self._append(queue, payload, about)
        for queue in self._queues.values():
            self._limit(queue)

    def _append(self, queue: _Queue, payload: bytes, about: dict[str, Any]) -> None:
        if missing := queue.losses.before(about["publication_sequence_number"]):
            self._lost(queue.topic, missing)
        queue.waiting.append((next(self._turns), payload))

    def _limit(self, queue: _Queue) -> None:
        if (excess := len(queue.waiting) - self._most) > 0:
            for _ in range(excess):
                queue.waiting.popleft()
            self._dropped(queue.topic, excess)

    def _handle(self) -> bool:
        """Handles the message that has waited longest; whether there was one."""
        filled = [queue for queue in self._queues.values() if queue.waiting]
        if not filled:
            return False
        first = min(filled, key=lambda queue: queue.waiting[0][0])
        first.handler(first.waiting.popleft()[1])
        return True
