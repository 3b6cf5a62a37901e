"""What is done to a filter from outside, between two sets: so that a replay can do the same.

An event takes effect at a place in the order of the stamps, not at a time of the clock: a live run
and its replay then agree.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from dopslam_ros.core.models.refusal import Refused
from dopslam_ros.core.session.checkpoint import BEFORE_ALL, Checkpoint

RESET, LOAD_MAP, RESUME, PAUSE, CONTINUE = "reset", "load_map", "resume", "pause", "continue"
KINDS = (RESET, LOAD_MAP, RESUME, PAUSE, CONTINUE)


@dataclass(frozen=True)
class Event:
    """One of KINDS.

    Attributes:
        kind: what was done.
        after_ns: it takes effect after the set with this stamp; BEFORE_ALL: before the first. Of a
            pause, the stamp of the last set that is taken.
        until_ns: of the end of a pause: the stamp of the last set that was not taken.
        saved: the map that was loaded, or the snapshot it went on from.
    """

    kind: str
    after_ns: int
    until_ns: int = 0
    saved: Checkpoint | None = None


class Pauses:
    """Which sets are not taken.

    A pause holds for the sets later than the newest one taken before it, up to the last one that
    came while it lasted. That is a matter of the stamps and of the order within the topic, so a
    replay that knows the pauses beforehand takes the same sets. Where time begins anew a pause is
    over.
    """

    def __init__(self) -> None:
        self._spans: deque[tuple[int, int | None]] = deque()
        self._refused_ns = BEFORE_ALL

    @property
    def now(self) -> bool:
        """Whether there is a pause that has no end yet."""
        return bool(self._spans) and self._spans[-1][1] is None

    def begin(self, after_ns: int) -> Event:
        """Sets later than this are not taken."""
        self._spans.append((after_ns, None))
        self._refused_ns = after_ns
        return Event(PAUSE, after_ns)

    def end(self, until_ns: int | None = None) -> Event:
        """Sets later than this, or than the last one refused, are taken again."""
        after, _ = self._spans.pop()
        until = self._refused_ns if until_ns is None else until_ns
        if until > after:
            self._spans.append((after, until))
        return Event(CONTINUE, after, until)

    def check(self, stamp_ns: int, newest_ns: int) -> None:
        """Raises Refused if a set is not taken; ``newest_ns`` is the newest that was."""
        while self._spans and newest_ns <= self._spans[0][0] < stamp_ns:
            until = self._spans[0][1]
            if until is None or stamp_ns <= until:
                self._refused_ns = max(self._refused_ns, stamp_ns)
                raise Refused("paused", "the filter is paused: call ~/pause with 'data: false'")
            self._spans.popleft()
