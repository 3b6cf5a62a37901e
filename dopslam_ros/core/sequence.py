"""Puts what arrives in the order of its stamps and finds the controls that lie between.

Snapshots and controls travel on different topics and overtake each other. A snapshot is released
once a control from its own time or later has arrived, because only then can no control before it be
on its way. What is released depends on stamps and on the order within each topic, not on how the
topics interleave; so a live run and its replay process the same things. The exception is a control
that comes too late: a wait has to end, and when it does the snapshot is marked as not complete.
"""

from __future__ import annotations

import bisect
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

from dopslam_ros.core.motion import Control, ControlSpan
from dopslam_ros.core.refusal import Refused

Item = TypeVar("Item")

# Snapshots that wait for controls; more than this many and the oldest is released as it is.
MOST_PENDING = 1000
# A stamp further ahead of the one before [ns] is believed when the next one confirms it.
LARGEST_JUMP_NS = 60 * 1_000_000_000
# Plausible controls [m/s], [rad/s].
FASTEST = 1e4
FASTEST_TURN = 1e3


@dataclass(frozen=True)
class Timed(Generic[Item]):
    """An item with what the vehicle did before it.

    Attributes:
        stamp_ns: its time.
        item: as it was added.
        spans: the controls since the item before; empty for the first one.
        control: the control valid at the item's time, or None if none is known.
        complete: whether every control that was needed had arrived.
    """

    stamp_ns: int
    item: Item
    spans: tuple[ControlSpan, ...]
    control: Control | None
    complete: bool


class Sequencer(Generic[Item]):
    """Orders items by stamp, each with the controls since the one before.

    Args:
        wait: how far [s] the newest item may be ahead of one that still waits for its control
            before that one is released without.
    """

    def __init__(self, wait: float) -> None:
        self._wait_ns = round(wait * 1e9)
        self._stamps: list[int] = []
        self._items: list[Item] = []
        self._control_stamps: list[int] = []
        self._controls: list[Control] = []
        self._item_clock = _StampClock()
        self._control_clock = _StampClock()
        self._last_ns: int | None = None

    @property
    def pending(self) -> int:
        """How many items wait."""
        return len(self._items)

    @property
    def newest_ns(self) -> int | None:
        """The stamp of the newest item that was added."""
        return self._item_clock.newest_ns

    @property
    def controls(self) -> tuple[tuple[int, Control], ...]:
        """The controls that items to come depend on, with their stamps [ns]."""
        return tuple(zip(self._control_stamps, self._controls, strict=True))

    def go_on(self, last_ns: int | None, controls: Sequence[tuple[int, Control]]) -> None:
        """A new one goes on as another did that had released the item of ``last_ns``.

        Args:
            last_ns: the stamp of that item, or None before the first.
            controls: what the other one had as ``controls``.
        """
        self._last_ns = self._item_clock.newest_ns = last_ns
        self._control_stamps = [stamp for stamp, _ in controls]
        self._controls = [control for _, control in controls]
        if controls:
            self._control_clock.newest_ns = controls[-1][0]

    def add_control(self, stamp_ns: int, speed: float, turn_rate: float) -> None:
        """A control, valid from its stamp until the next.

        Raises:
            Refused: not a plausible number, not newer than the control before, or far ahead.
        """
        plausible = abs(speed) <= FASTEST and abs(turn_rate) <= FASTEST_TURN
        if not (math.isfinite(speed) and math.isfinite(turn_rate) and plausible):
            raise Refused(
                "invalid_control",
                f"control (speed {speed:g} m/s, turn rate {turn_rate:g} rad/s) is not usable:"
                " linear.x and angular.z must be finite",
            )
        self._control_clock.accept(stamp_ns, "backward_control", "backward_control")
        self._control_stamps.append(stamp_ns)
        self._controls.append(Control(speed, turn_rate))

    def add(self, stamp_ns: int, item: Item) -> None:
        """An item to release in its turn.

        Raises:
            Refused: its time is not later than that of the one added before, or far ahead of it.
        """
        self._item_clock.accept(stamp_ns, "backward_time", "duplicate_stamp")
        self._stamps.append(stamp_ns)
        self._items.append(item)

    def ready(self) -> Iterator[Timed[Item]]:
        """Releases what need not wait any longer, in order."""
        while self._stamps:
            covered = bool(self._control_stamps) and self._control_stamps[-1] >= self._stamps[0]
            overdue = self._stamps[-1] - self._stamps[0] >= self._wait_ns
            if not (covered or overdue or len(self._stamps) > MOST_PENDING):
                return
            yield self._release(covered)

    def flush(self) -> Iterator[Timed[Item]]:
        """Releases everything: no more inputs will come."""
        yield from self.ready()
        while self._stamps:
            yield self._release(complete=False)

    def _release(self, complete: bool) -> Timed[Item]:
        stamp, item = self._stamps.pop(0), self._items.pop(0)
        spans = () if self._last_ns is None else self._spans(self._last_ns, stamp)
        current = bisect.bisect_right(self._control_stamps, stamp) - 1
        control = self._controls[current] if current >= 0 else None
        self._last_ns = stamp
        del self._control_stamps[: max(current, 0)], self._controls[: max(current, 0)]
        known = control is not None and all(span.control is not _UNKNOWN for span in spans)
        return Timed(stamp, item, spans, control, complete and known)

    def _spans(self, start: int, end: int) -> tuple[ControlSpan, ...]:
        """The controls between two times; before the first one the vehicle is taken to stand."""
        first = bisect.bisect_right(self._control_stamps, start)
        last = bisect.bisect_left(self._control_stamps, end)
        edges = [start, *self._control_stamps[first:last], end]
        before = self._controls[first - 1] if first > 0 else _UNKNOWN
        controls = [before, *self._controls[first:last]]
        return tuple(
            ControlSpan(control, (after - ahead) * 1e-9)
            for control, ahead, after in zip(controls, edges, edges[1:], strict=False)
        )


class _StampClock:
    """Stamps of one topic must increase; a single one from far ahead must not lock out the rest."""

    def __init__(self) -> None:
        self.newest_ns: int | None = None
        self._suspect_ns: int | None = None

    def accept(self, stamp_ns: int, backward: str, duplicate: str) -> None:
        """Takes a stamp or raises Refused, with one of the two reasons or ``jump_ahead``."""
        newest, suspect = self.newest_ns, self._suspect_ns
        if newest is not None and stamp_ns <= newest:
            raise Refused(
                duplicate if stamp_ns == newest else backward,
                f"stamp {_seconds(stamp_ns)} is not later than that of the one before,"
                f" {_seconds(newest)}: stamps must increase",
            )
        if newest is not None and stamp_ns - newest > LARGEST_JUMP_NS:
            confirmed = suspect is not None and 0 < stamp_ns - suspect <= LARGEST_JUMP_NS
            if not confirmed:
                self._suspect_ns = stamp_ns
                raise Refused(
                    "jump_ahead",
                    f"stamp {_seconds(stamp_ns)} is more than {_seconds(LARGEST_JUMP_NS)} ahead of"
                    f" {_seconds(newest)}: believed when the next one confirms it",
                )
        self.newest_ns, self._suspect_ns = stamp_ns, None


_UNKNOWN = Control(0.0, 0.0)


def _seconds(stamp_ns: int) -> str:
    return f"{stamp_ns // 1_000_000_000}.{stamp_ns % 1_000_000_000:09d} s"
