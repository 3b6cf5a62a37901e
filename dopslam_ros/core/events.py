"""What is done to a filter from outside, between two sets: so that a replay can do the same.

An event takes effect at a place in the order of the stamps, not at a time of the clock: a live run
and its replay then agree.
"""

from __future__ import annotations

from dataclasses import dataclass

from dopslam_ros.core.refusal import Refused
from dopslam_ros.core.saved import Saved

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
    saved: Saved | None = None


class Pauses:
    """Which sets are not taken: those with a stamp inside a pause.

    Attributes:
        now: whether there is a pause that has no end yet.
    """

    def __init__(self) -> None:
        self._over: list[tuple[int, int]] = []
        self._after_ns = 0
        self._until_ns = 0
        self.now = False

    def begin(self, after_ns: int) -> Event:
        """Sets later than this are not taken, unless they are not already."""
        if not self.now:
            self.now, self._after_ns, self._until_ns = True, after_ns, after_ns
        return Event(PAUSE, self._after_ns)

    def end(self, until_ns: int | None = None) -> Event:
        """Sets later than this, or than the last one refused, are taken again."""
        after, until = self._after_ns, self._until_ns if until_ns is None else until_ns
        if self.now and until > after:
            self._over.append((after, until))
        self.now = False
        return Event(CONTINUE, after, until)

    def check(self, stamp_ns: int) -> None:
        """Raises Refused if a set is not taken."""
        inside = any(after < stamp_ns <= until for after, until in self._over)
        if self.now and stamp_ns > self._after_ns:
            inside, self._until_ns = True, max(self._until_ns, stamp_ns)
        if inside:
            raise Refused("paused", "the filter is paused: call ~/pause with 'data: false'")
