"""Ctrl-C in what calls compiled functions: it waits for the end of a step.

Python raises KeyboardInterrupt wherever it happens to be. On the way into or out of a compiled
function that comes out as a SystemError, or crashes the process.
"""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Iterable, Iterator
from types import TracebackType
from typing import Any, ClassVar, TypeVar

T = TypeVar("T")


class Stop:
    """Within it Ctrl-C only ends loops over ``until_stopped(...)``; a second one is as ever.

    A Stop within another leaves it to that one. Where Ctrl-C is ignored, as who starts a command in
    the background wants it, and in other threads than the main one, which it never meets, a Stop
    does nothing.

    Args:
        keep: the loops end as if there were no more items, so that what was done can be kept;
            without it they, or else the end of the block, raise KeyboardInterrupt.

    Attributes:
        asked: whether Ctrl-C came.
    """

    in_force: ClassVar[Stop | None] = None

    def __init__(self, keep: bool = False) -> None:
        self.keep = keep
        self.asked = False
        self._before: Any = None

    def __enter__(self) -> Stop:
        ignored = signal.getsignal(signal.SIGINT) == signal.SIG_IGN
        main = threading.current_thread() is threading.main_thread()
        if Stop.in_force is None and main and not ignored:
            Stop.in_force = self
            self._before = signal.signal(signal.SIGINT, self._ask)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, _: BaseException | None, __: TracebackType | None
    ) -> None:
        if Stop.in_force is not self:
            return
        signal.signal(signal.SIGINT, self._before)
        Stop.in_force = None
        if self.asked and not self.keep and kind is None:
            raise KeyboardInterrupt

    def code(self) -> int:
        """The exit code of a command that has kept what it had; says so if it was stopped."""
        if self.asked:
            print("dopslam: stopped; what was done by then is kept", file=sys.stderr)
        return 130 if self.asked else 0

    def _ask(self, *_: object) -> None:
        if self.asked:
            raise KeyboardInterrupt
        self.asked = True


def until_stopped(items: Iterable[T]) -> Iterator[T]:
    """The same items, until Ctrl-C comes within a Stop.

    Raises:
        KeyboardInterrupt: it came, and the Stop is not to keep what was done.
    """
    for item in items:
        stop = Stop.in_force
        if stop is not None and stop.asked:
            if stop.keep:
                return
            raise KeyboardInterrupt
        yield item
