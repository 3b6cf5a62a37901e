"""What the middleware lost of a topic.

When a queue runs over, the middleware drops without a word: where this was written, with Fast DDS,
its event for lost messages stays silent. But every publisher numbers its messages.
"""

from __future__ import annotations

import time

from rclpy.node import Node

# A topic with several publishers is not looked at again for so long [s].
BLIND_SECONDS = 1.0


class Losses:
    """Finds gaps in the numbers of a topic's messages.

    A message does not say whose number it has. So a gap counts only while the topic has one
    publisher, and the same as when the number before came: rather too few are counted than some
    that nobody sent.

    Args:
        node: who listens.
        topic: full name.
    """

    def __init__(self, node: Node, topic: str) -> None:
        self._node = node
        self._topic = topic
        self._last: int | None = None
        self._known: list[bytes] = []
        self._blind_until = 0.0

    def before(self, number: int | None) -> int:
        """How many were lost between the message before and this one.

        Args:
            number: of the message; None: the middleware gives none, and nothing is counted.
        """
        last, self._last = self._last, number
        if number is None or (last is not None and number == last + 1):
            return 0
        if time.monotonic() < self._blind_until:
            return 0
        known, self._known = self._known, self._publishers()
        if len(self._known) > 1:
            self._blind_until = time.monotonic() + BLIND_SECONDS
            return 0
        if last is None or known != self._known:
            return 0
        if number <= last:  # of somebody who has left already
            self._known = []
            return 0
        return number - last - 1

    def _publishers(self) -> list[bytes]:
        found = self._node.get_publishers_info_by_topic(self._topic)
        return sorted(bytes(info.endpoint_gid) for info in found)
