"""Puts what arrives in the order of its stamps and finds the controls that lie between.

Snapshots and controls travel on different topics and overtake each other. A snapshot is released
once a control from its own time or later has arrived, because only then can no control before it be
on its way. What is released depends on stamps and on the order within each topic, not on how the
topics interleave; so a live run and its replay process the same things. The exception is a control
that comes too late: a wait has to end, and when it does the snapshot is marked as not complete.

When stamps jump back, as in a bag that is played again, time begins anew: see ``ordering``.
"""

from __future__ import annotations

import bisect
import itertools
import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

from dopslam_ros.core.models.motion import NO_DRIFT, Control, ControlSpan, Drift
from dopslam_ros.core.models.refusal import Refused
from dopslam_ros.core.session.ordering import Instant, Stream
from dopslam_ros.core.settings.model import OnlineParameters

Item = TypeVar("Item")

# Snapshots that wait for controls; more than this many and the oldest is released as it is.
MOST_PENDING = 1000
# So many controls before a snapshot are used, the newest; twice as many are kept while none comes.
MOST_CONTROLS = 20_000
UNUSED_CONTROL = "unused_control"
# Plausible controls [m/s], [rad/s].
FASTEST = 1e4
FASTEST_TURN = 1e3
# For so long [s] an old control's error grows as under a constant acceleration, then steadily.
LONGEST_ACCELERATION = 10.0
UNKNOWN = Control(0.0, 0.0)


@dataclass(frozen=True)
class Timed(Generic[Item]):
    """An item with what the vehicle did before it.

    Attributes:
        stamp_ns: its time.
        item: as it was added.
        spans: the controls since the item before; empty for the first one.
        control: the control valid at the item's time, or None if none is known.
        complete: whether every control that was needed had arrived.
        anew: whether time has begun anew: the first after the stamps jumped back.
        stale: whether the control is so old that its speed says little.
    """

    stamp_ns: int
    item: Item
    spans: tuple[ControlSpan, ...]
    control: Control | None
    complete: bool
    anew: bool = False
    stale: bool = False


class Sequencer(Generic[Item]):
    """Orders items by stamp, each with the controls since the one before.

    Args:
        parameters: how long is waited, and what an old control is worth.
    """

    def __init__(self, parameters: OnlineParameters) -> None:
        self._parameters = parameters
        self._wait_ns = round(parameters.control_wait * 1e9)
        window = parameters.reorder_window
        self._items: Stream[Item] = Stream("set", "late", window)
        self._controls: Stream[Control] = Stream("control", "late_control", window)
        self._first: Instant | None = None
        self._last: Instant | None = None
        self._alone_since_ns: int | None = None

    @property
    def pending(self) -> int:
        """How many items wait."""
        return len(self._items.times)

    @property
    def newest_ns(self) -> int | None:
        """The stamp of the newest item that was added."""
        return self._items.newest_ns

    @property
    def controls(self) -> tuple[tuple[int, Control], ...]:
        """The controls that items to come depend on, with their stamps [ns]."""
        now = self._items.round if self._last is None else self._last.round
        pairs = zip(self._controls.times, self._controls.values, strict=True)
        return tuple((time.stamp_ns, control) for time, control in pairs if time.round == now)

    def take_problems(self) -> Counter[str]:
        """What was met since the last call and concerned no message just added."""
        found = self._items.problems + self._controls.problems
        self._items.problems.clear()
        self._controls.problems.clear()
        return found

    def go_on(self, last_ns: int | None, controls: Sequence[tuple[int, Control]]) -> None:
        """A new one goes on as another did that had released the item of ``last_ns``.

        Args:
            last_ns: the stamp of that item, or None before the first.
            controls: what the other one had as ``controls``.
        """
        self._items.newest_ns = last_ns
        self._first = self._last = None if last_ns is None else Instant(0, last_ns)
        for stamp, control in controls:
            self._controls.add(stamp, control)

    def add_control(self, stamp_ns: int, speed: float, turn_rate: float) -> None:
        """A control, valid from its stamp until the next.

        Raises:
            Refused: not a plausible number, or not newer than the control before by more than the
                window for sorting.
        """
        plausible = abs(speed) <= FASTEST and abs(turn_rate) <= FASTEST_TURN
        if not (math.isfinite(speed) and math.isfinite(turn_rate) and plausible):
            raise Refused(
                "invalid_control",
                f"control (speed {speed:g} m/s, turn rate {turn_rate:g} rad/s) is not usable:"
                " linear.x and angular.z must be finite",
            )
        self._controls.add(stamp_ns, Control(speed, turn_rate))
        if len(self._controls.times) > 2 * MOST_CONTROLS + 1:
            self._controls.forget(1, after=1)  # the first one holds since the last snapshot
            if self._last is not None:
                self._controls.problems[UNUSED_CONTROL] += 1

    def add(self, stamp_ns: int, item: Item) -> None:
        """An item to release in its turn.

        Raises:
            Refused: its time is not later than that of the newest one by more than the window for
                sorting, or it is there already.
        """
        self._items.add(stamp_ns, item, self._last)
        self._rejoin_rounds(stamp_ns)

    def ready(self) -> Iterator[Timed[Item]]:
        """Releases what need not wait any longer, in order."""
        while self._items.times:
            first = self._items.times[0]
            covered = self._controls.reached(first)
            due = (covered and self._items.reached(first)) or self._overdue(first)
            if not (due or self.pending > MOST_PENDING):
                return
            yield self._release(covered)

    def flush(self) -> Iterator[Timed[Item]]:
        """Releases everything: no more inputs will come."""
        yield from self.ready()
        while self._items.times:
            yield self._release(self._controls.reached(self._items.times[0]))

    def end(self) -> Iterator[Timed[Item]]:
        """Releases everything for good; what was kept aside is counted as a problem."""
        self._items.end()
        self._controls.end()
        yield from self.flush()

    def _overdue(self, first: Instant) -> bool:
        """Whether an item has waited long enough, by the stamps of those after it."""
        newest = self._items.newest_ns
        assert newest is not None
        if self._items.round == first.round:
            return newest - first.stamp_ns >= self._wait_ns
        start = bisect.bisect_left(self._items.times, Instant(self._items.round, 0))
        return newest - self._items.times[start].stamp_ns >= self._wait_ns

    def _rejoin_rounds(self, stamp_ns: int) -> None:
        """Time that begins anew on one topic only is given up after a while."""
        if self._items.round == self._controls.round or self._controls.newest_ns is None:
            self._alone_since_ns = None
        elif self._alone_since_ns is None or stamp_ns < self._alone_since_ns:
            self._alone_since_ns = stamp_ns
        elif stamp_ns - self._alone_since_ns >= self._wait_ns:
            self._controls.join(self._items.round)

    def _release(self, reached: bool) -> Timed[Item]:
        time, item = self._items.times[0], self._items.values[0]
        self._items.forget(1)
        last, self._last = self._last, time
        anew = last is not None and last.round < time.round
        if last is None or anew:
            self._first = time
        spans = () if last is None or anew else self._spans(last, time)
        control, current = self._control_at(time)
        stale = control is not None and self._age(time, current) > self._parameters.control_timeout
        self._controls.forget(max(current, 0))
        known = control is not None and all([span.control is not UNKNOWN for span in spans])
        complete = reached and known and self._any_of_round_after(time)
        return Timed(time.stamp_ns, item, spans, control, complete, anew, stale)

    def _any_of_round_after(self, time: Instant) -> bool:
        """Whether a control of an instant or later, in its round, has come."""
        at = bisect.bisect_left(self._controls.times, time)
        return at < len(self._controls.times) and self._controls.times[at].round == time.round

    def _control_at(self, time: Instant) -> tuple[Control | None, int]:
        """The control that holds then and its place, -1 before all of them."""
        place = bisect.bisect_right(self._controls.times, time) - 1
        if place < 0 or self._controls.times[place].round != time.round:
            return None, place
        return self._controls.values[place], place

    def _age(self, time: Instant, place: int) -> float:
        """Of the control at a place, by that time [s]."""
        return (time.stamp_ns - self._controls.times[place].stamp_ns) * 1e-9

    def _spans(self, start: Instant, end: Instant) -> tuple[ControlSpan, ...]:
        """The controls between two times; before the first one the vehicle is taken to stand.

        Of more than MOST_CONTROLS the oldest are not used: the one before them is taken to hold.
        """
        times = self._controls.times
        between = times[bisect.bisect_right(times, start) : bisect.bisect_left(times, end)]
        if (excess := len(between) - MOST_CONTROLS) > 0:
            self._controls.problems[UNUSED_CONTROL] += excess
        edges = [start, *between[-MOST_CONTROLS:], end]
        return tuple([self._span(ahead, after) for ahead, after in itertools.pairwise(edges)])

    def _span(self, start: Instant, end: Instant) -> ControlSpan:
        """The time between two instants, at the first of which a control may begin."""
        control, place = self._control_at(start)
        since = self._controls.times[place] if control is not None else self._first or start
        before, after = [(t.stamp_ns - since.stamp_ns) * 1e-9 for t in (start, end)]
        drift = NO_DRIFT
        if after > self._parameters.control_timeout:
            (a, b), (c, d) = self._left(before), self._left(after)
            drift = Drift(c - a, d - b)
        return ControlSpan(control or UNKNOWN, (end.stamp_ns - start.stamp_ns) * 1e-9, drift)

    def _left(self, age: float) -> Drift:
        """How far the vehicle may have left what a control of that age [s] says."""
        old = max(age - self._parameters.control_timeout, 0.0)
        free = min(old, LONGEST_ACCELERATION)
        grown = 0.5 * free**2 + free * (old - free)
        return Drift(
            (self._parameters.coasting_acceleration * grown) ** 2,
            min(self._parameters.coasting_turn_acceleration * grown, math.pi) ** 2,
        )


# Time began anew, and with it everything that was estimated.
BEGUN_ANEW = "reset_backward_jump"
