"""What a command says of itself while it runs: a bar, or nothing at all."""

from __future__ import annotations

import contextlib
import math
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from typing import TypeVar

T = TypeVar("T")
# Between two pictures of a progress bar.
REDRAW_SECONDS = 0.1


@contextlib.contextmanager
def silence(quiet: bool) -> Iterator[None]:
    """Nothing is printed meanwhile if so; errors that are raised can be told afterwards."""
    if not quiet:
        yield
        return
    with (
        open(os.devnull, "w", encoding="utf-8") as nowhere,
        contextlib.redirect_stdout(nowhere),
        contextlib.redirect_stderr(nowhere),
    ):
        yield


def with_progress(
    items: Iterable[T], total: int | None, description: str, done: int = 0
) -> Iterator[T]:
    """The same items, with a bar on a terminal; ``done`` of the total were there before."""
    with progress_bar(total, description, done) as show:
        for number, item in enumerate(items, done + 1):
            yield item
            show(number)


@contextlib.contextmanager
def progress_bar(
    total: int | None, description: str, done: int = 0
) -> Iterator[Callable[[int], None]]:
    """A bar at the bottom of a terminal; what else is written to stderr comes above it.

    Args:
        total: how many there will be, where that is known.
        description: what is counted.
        done: how many there were before; they say nothing about the speed.

    Yields:
        Function that is told how many are done.
    """
    if not sys.stderr.isatty():
        yield lambda number: None
        return
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    with Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=Console(stderr=True),
        auto_refresh=False,  # its thread could hold a lock when the workers of a study are forked
        speed_estimate_period=math.inf,  # a single item may take minutes
        redirect_stdout=False,  # results go where they were sent, not to stderr
    ) as bar:
        task, drawn = bar.add_task(description, total=total, completed=done), time.monotonic()

        def show(number: int) -> None:
            nonlocal drawn
            now = time.monotonic()
            due = now - drawn >= REDRAW_SECONDS
            drawn = now if due else drawn
            bar.update(task, completed=number, refresh=due)

        yield show
