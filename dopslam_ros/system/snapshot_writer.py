"""The snapshot of a filter that runs, written by a thread of its own."""

from __future__ import annotations

import fcntl
import os
import threading
import time
from pathlib import Path

from dopslam_ros.core.session.checkpoint import SNAPSHOT, Checkpoint, CheckpointError
from dopslam_ros.system.storage import Store


class SnapshotWriter:
    """Writes the newest of the snapshots it is offered, in a thread of its own.

    What it is offered is immutable, so nobody waits for the disk.

    Args:
        store: where.
        name: of the file. Two writers cannot have the same.
        period: least time between the beginnings of two writes [s].

    Attributes:
        written: how many were written.
        failed: how many could not be.
        problem: why the last one could not be written; None when it could.
        written_at: steady time of the last one [s].

    Raises:
        CheckpointError: the name is unusable, in use, or its folder cannot be made.
    """

    def __init__(self, store: Store, name: str, period: float) -> None:
        self._store, self._name, self._period = store, name, period
        self.written = self.failed = 0
        self.problem: str | None = None
        self.written_at: float | None = None
        self._lock = self._locked(store.path(name, SNAPSHOT))
        self._changed = threading.Condition()
        self._next: Checkpoint | None = None
        self._closing = False
        self._thread = threading.Thread(target=self._run, name="snapshots", daemon=True)
        self._thread.start()

    def offer(self, saved: Checkpoint) -> None:
        """The newest state; one that was not written yet is forgotten."""
        with self._changed:
            self._next = saved
            self._changed.notify()

    def close(self) -> None:
        """Writes the last one and ends."""
        with self._changed:
            self._closing = True
            self._changed.notify()
        self._thread.join()
        os.close(self._lock)

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._next is not None or self._closing)
                saved, self._next = self._next, None
            if saved is None:
                return
            started = time.monotonic()
            try:
                self._store.write(self._name, saved)
            except Exception as error:  # neither a full disk nor anything else ends the run
                self.failed, self.problem = self.failed + 1, str(error)
            else:
                self.written, self.problem = self.written + 1, None
                self.written_at = time.monotonic()
            with self._changed:
                rest = started + self._period - time.monotonic()
                self._changed.wait_for(lambda: self._closing, max(rest, 0.0))

    def _locked(self, path: Path) -> int:
        """A lock that the system releases whenever this process ends."""
        lock = path.with_name(path.name + ".lock")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            flags = os.O_WRONLY | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC
            descriptor = os.open(lock, flags, 0o666)
        except OSError as error:
            raise CheckpointError(f"'{lock}' cannot be made: {error.strerror}") from error
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            os.close(descriptor)
            raise CheckpointError(
                f"another filter writes the snapshot '{path}': give each one a name of its own"
            ) from error
        return descriptor
