"""What waits for a node that cannot keep up: a queue of stated length, and a count of what is lost.

The middleware's own queue would drop without a word.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from typing import Any

from rclpy.node import Node

Handler = Callable[[bytes], None]
# After so long [s] the node's services and timers get their turn.
LONGEST_TURN = 0.01


class Inbox:
    """Messages in the order they arrived; a message of one kind is dropped when too many wait.

    The oldest are dropped: what comes last says most about the present.

    Args:
        node: whose messages they are.
        most: of the kind that counts, so many may wait.
        dropped: called for each message that is dropped.
    """

    def __init__(self, node: Node, most: int, dropped: Callable[[], None]) -> None:
        self._most = most
        self._dropped = dropped
        self._counted = 0
        self._waiting: deque[tuple[Handler, bytes, bool]] = deque()
        self._sources: list[tuple[Any, Handler, bool]] = []
        self._wake: Any = node.create_guard_condition(self._turn)

    @property
    def waiting(self) -> int:
        """How many messages of the kind that counts wait."""
        return self._counted

    def watch(self, subscription: Any, handler: Handler, counts: bool) -> None:
        """Reads what a subscription has when the middleware's queue is to be emptied."""
        self._sources.append((subscription, handler, counts))

    def put(self, handler: Handler, payload: bytes, counts: bool) -> None:
        """A message that has come: it is handled in its turn."""
        self._append(handler, payload, counts)
        self._turn()

    def empty(self) -> None:
        """Handles all that waits."""
        while self._waiting:
            self._handle()

    def _turn(self) -> None:
        """Handles what has come, and what comes meanwhile, for a while."""
        end = time.monotonic() + LONGEST_TURN
        self._take_in()
        while self._waiting and time.monotonic() < end:
            self._handle()
            self._take_in()
        if self._waiting:
            self._wake.trigger()

    def _take_in(self) -> None:
        came: list[tuple[int, Handler, bytes, bool]] = []
        for subscription, handler, counts in self._sources:
            with subscription.handle:
                while (taken := subscription.handle.take_message(bytes, True)) is not None:
                    payload, about = taken
                    came.append((about["received_timestamp"], handler, payload, counts))
        for _, handler, payload, counts in sorted(came, key=lambda one: one[0]):
            self._append(handler, payload, counts)

    def _append(self, handler: Handler, payload: bytes, counts: bool) -> None:
        self._waiting.append((handler, payload, counts))
        self._counted += counts
        if self._counted > self._most:
            oldest = next(k for k, (_, _, counted) in enumerate(self._waiting) if counted)
            del self._waiting[oldest]
            self._counted -= 1
            self._dropped()

    def _handle(self) -> None:
        """Handles the message that has waited longest."""
        handler, payload, counts = self._waiting.popleft()
        self._counted -= counts
        handler(payload)
