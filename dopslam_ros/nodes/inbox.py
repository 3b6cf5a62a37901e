"""What waits for a node that cannot keep up: queues of stated length, and a count of what is lost.

The middleware's own queue would drop without a word.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from itertools import count
from typing import Any

from rclpy.node import Node

Handler = Callable[[bytes], None]
# After so long [s] the node's services and timers get their turn.
LONGEST_TURN = 0.01


class _Queue:
    """The messages of one subscription that wait, each with its turn."""

    def __init__(self, topic: str, subscription: Any, handler: Handler) -> None:
        self.topic = topic
        self.subscription = subscription
        self.handler = handler
        self.waiting: deque[tuple[int, bytes]] = deque()


class Inbox:
    """Messages of several topics in the order they arrived; of each topic only so many wait.

    The oldest are dropped: what comes last says most about the present. That goes for every topic:
    one that nobody limits would take all of the node's time from the others.

    Args:
        node: whose messages they are.
        most: messages of a topic that may wait.
        dropped: called with the topic's name for each message that is dropped.
    """

    def __init__(self, node: Node, most: int, dropped: Callable[[str], None]) -> None:
        self._most = most
        self._dropped = dropped
        self._turns = count()
        self._queues: dict[str, _Queue] = {}
        self._wake: Any = node.create_guard_condition(self._turn)

    def waiting(self, topic: str) -> int:
        """How many messages of a topic wait."""
        return len(self._queues[topic].waiting) if topic in self._queues else 0

    def watch(self, topic: str, subscription: Any, handler: Handler) -> None:
        """Makes a queue for what a subscription gets and a handler is to have."""
        self._queues[topic] = _Queue(topic, subscription, handler)

    def put(self, topic: str, payload: bytes) -> None:
        """A message that has come: it is handled in its turn."""
        self._append(self._queues[topic], payload)
        self._turn()

    def empty(self) -> None:
        """Handles all that waits."""
        while self._handle():
            pass

    def _turn(self) -> None:
        """Handles what has come, and what comes meanwhile, for a while."""
        end = time.monotonic() + LONGEST_TURN
        self._take_in()
        while (left := self._handle()) and time.monotonic() < end:
            self._take_in()
        if left:
            self._wake.trigger()

    def _take_in(self) -> None:
        came: list[tuple[int, _Queue, bytes]] = []
        for queue in self._queues.values():
            handle = queue.subscription.handle
            with handle:
                while (taken := handle.take_message(bytes, True)) is not None:
                    payload, about = taken
                    came.append((about["received_timestamp"], queue, payload))
        for _, queue, payload in sorted(came, key=lambda one: one[0]):
            self._append(queue, payload)

    def _append(self, queue: _Queue, payload: bytes) -> None:
        queue.waiting.append((next(self._turns), payload))
        if len(queue.waiting) > self._most:
            queue.waiting.popleft()
            self._dropped(queue.topic)

    def _handle(self) -> bool:
        """Handles the message that has waited longest; whether there was one."""
        filled = [queue for queue in self._queues.values() if queue.waiting]
        if not filled:
            return False
        first = min(filled, key=lambda queue: queue.waiting[0][0])
        first.handler(first.waiting.popleft()[1])
        return True
