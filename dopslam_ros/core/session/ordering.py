"""The messages of one topic in the order of their stamps, whatever stamps they come with.

What is taken and what is refused depends on the stamps and on their order within the topic alone.
"""

from __future__ import annotations

import bisect
from collections import Counter
from typing import Generic, NamedTuple, TypeVar

from dopslam_ros.core.models.refusal import Refused

Value = TypeVar("Value")

NANO = 1_000_000_000
# A stamp further ahead of the newest [ns] is believed when the next one confirms it.
LARGEST_JUMP_NS = 60 * NANO
# So is one further behind: time has begun anew, as in a bag that is played again.
LARGEST_LAG_NS = 5 * NANO
UNCONFIRMED = "unconfirmed_stamp"


class Instant(NamedTuple):
    """When something was: rounds are counted each time that the stamps begin anew."""

    round: int
    stamp_ns: int


class Stream(Generic[Value]):
    """Messages of one topic that are still needed, in order.

    Attributes:
        round: of the newest message; counts how often the stamps have jumped back.
        newest_ns: largest stamp of this round, or None before the first message.
        times: when the messages were, ascending.
        values: the messages.
        problems: stamps that jumped and were not confirmed by the next.

    Args:
        kind: what the messages are, in words.
        late: the reason given for those that come too late.
        window: how much later [s] than a newer one a message may come and still be sorted in.
    """

    def __init__(self, kind: str, late: str, window: float) -> None:
        self.round = 0
        self.newest_ns: int | None = None
        self.times: list[Instant] = []
        self.values: list[Value] = []
        self.problems: Counter[str] = Counter()
        self._kind = kind
        self._late = late
        self._window_ns = round(window * 1e9)
        self._held: tuple[int, Value] | None = None

    def add(self, stamp_ns: int, value: Value, passed: Instant | None = None) -> None:
        """Takes a message.

        A stamp that jumps is kept aside until the next one confirms it or not.

        Args:
            stamp_ns: its stamp.
            value: what it says.
            passed: instant that nothing may be sorted in before any more.

        Raises:
            Refused: it is too late, or there is one with its stamp.
        """
        held, self._held = self._held, None
        if held is not None and self._jumps(stamp_ns) and 0 < stamp_ns - held[0] <= LARGEST_JUMP_NS:
            self._begin_at(*held)
        elif held is not None:
            self.problems[UNCONFIRMED] += 1
        if self._jumps(stamp_ns):
            self._held = (stamp_ns, value)
            return
        self._check(stamp_ns, passed)
        self._insert(stamp_ns, value)

    def reached(self, instant: Instant) -> bool:
        """Whether no message of that time or before can come any more."""
        if self.newest_ns is None or self.round != instant.round:
            return self.newest_ns is not None and self.round > instant.round
        return self.newest_ns - self._window_ns >= instant.stamp_ns

    def forget(self, count: int, after: int = 0) -> None:
        """Drops the oldest messages, but not so many that are older still."""
        gone = slice(after, after + count)
        del self.times[gone], self.values[gone]

    def end(self) -> None:
        """No more messages will come: what is kept aside is not confirmed."""
        if self._held is not None:
            self.problems[UNCONFIRMED] += 1
            self._held = None

    def join(self, round_: int) -> None:
        """Goes on in another round: its older messages are dropped, if it was behind all of them.

        For a topic whose stamps have not begun anew together with those of another one.
        """
        ahead = round_ < self.round
        first = bisect.bisect_left(self.times, Instant(self.round, 0)) if ahead else None
        del self.times[:first], self.values[:first]
        self.times = [Instant(round_, stamp) for _, stamp in self.times]
        self.newest_ns = self.times[-1].stamp_ns if self.times else None
        self.round = round_

    def _jumps(self, stamp_ns: int) -> bool:
        if self.newest_ns is None:
            return False
        return not -LARGEST_LAG_NS <= stamp_ns - self.newest_ns <= LARGEST_JUMP_NS

    def _check(self, stamp_ns: int, passed: Instant | None) -> None:
        if self.newest_ns is None:
            return
        time = Instant(self.round, stamp_ns)
        if stamp_ns == self.newest_ns or self._has(time) or time == passed:
            raise Refused(
                "duplicate_stamp",
                f"there is a {self._kind} of {seconds(stamp_ns)} already: give each a stamp of its"
                " own",
            )
        too_late = stamp_ns <= self.newest_ns - self._window_ns
        if too_late or (passed is not None and time < passed):
            raise Refused(
                self._late,
                f"a {self._kind} of {seconds(stamp_ns)} came after one of"
                f" {seconds(self.newest_ns)}: send them in order, or set reorder_window"
                f" ({self._window_ns * 1e-9:g} s) to the delay that must be waited for",
            )

    def _has(self, time: Instant) -> bool:
        at = bisect.bisect_left(self.times, time)
        return at < len(self.times) and self.times[at] == time

    def _begin_at(self, stamp_ns: int, value: Value) -> None:
        """Takes the message after a jump."""
        assert self.newest_ns is not None
        if stamp_ns < self.newest_ns:
            self.round += 1
        self.newest_ns = None
        self._insert(stamp_ns, value)

    def _insert(self, stamp_ns: int, value: Value) -> None:
        time = Instant(self.round, stamp_ns)
        at = bisect.bisect_right(self.times, time)
        self.times.insert(at, time)
        self.values.insert(at, value)
        self.newest_ns = stamp_ns if self.newest_ns is None else max(stamp_ns, self.newest_ns)


def seconds(stamp_ns: int) -> str:
    """A stamp in words."""
    return f"{stamp_ns // NANO}.{stamp_ns % NANO:09d} s"
