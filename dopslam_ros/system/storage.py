"""Maps and snapshots on disk: one folder, plain names, files that are whole or not there."""

from __future__ import annotations

import fcntl
import os
import re
import threading
import time
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from dopslam_ros.core.session.checkpoint import MAP, SNAPSHOT, Checkpoint, CheckpointError
from dopslam_ros.core.session.checkpoint_file import MOST_BYTES, decode, encode
from dopslam_ros.core.settings.parameters import parameter
from dopslam_ros.system.files import read_bounded, write_whole

SUFFIXES = {MAP: ".dopmap", SNAPSHOT: ".dopstate"}
_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,99}")


@dataclass(frozen=True)
class StorageParameters:
    """Where maps and snapshots are, and what a filter starts from."""

    map_directory: str = parameter(
        "~/.ros/dopslam",
        "Folder of all maps and snapshots; nothing is read or written elsewhere. It is made when"
        " something is saved.",
    )
    map: str = parameter("", "Name of a map to start with, in map_directory; empty: none.")
    snapshot: str = parameter(
        "",
        "Name of a file in map_directory that has the state of the filter all the time, so that it"
        " can go on where it was; empty: none.",
    )
    snapshot_period: float = parameter(
        0.5, "Time between two snapshots.", unit="s", low=0.01, high=1.0
    )
    resume: bool = parameter(False, "Whether to go on from the snapshot when there is one.")
    resume_age: float = parameter(
        60.0,
        "A snapshot written longer ago than this is too old to go on from.",
        unit="s",
        low=0.0,
        high=1e9,
    )


def read_checkpoint(path: Path) -> Checkpoint:
    """A map or a snapshot from a file.

    Raises:
        CheckpointError: there is no such file, or it cannot be used; the message names it.
    """
    try:
        return decode(read_bounded(path, MOST_BYTES))
    except OSError as error:
        raise CheckpointError(f"'{path}' cannot be read: {error.strerror}") from error
    except CheckpointError as error:
        raise CheckpointError(f"'{path}' cannot be used: {error}") from error


def write_checkpoint(path: Path, saved: Checkpoint) -> None:
    """Writes a map or a snapshot; raises OSError."""
    write_whole(path, *encode(saved), lasting=True)


class Store:
    """The folder that all names given from outside are looked up in.

    Args:
        folder: its path; ``~`` is the user's home.
    """

    def __init__(self, folder: str) -> None:
        self._given = folder

    @cached_property
    def folder(self) -> Path:
        """Its absolute path.

        Raises:
            CheckpointError: the user has no home.
        """
        try:
            return Path(self._given).expanduser().absolute()
        except RuntimeError as error:
            raise CheckpointError(f"parameter 'map_directory' = {self._given}: {error}") from error

    def path(self, name: str, kind: str) -> Path:
        """Where the map or snapshot of a name is.

        Raises:
            CheckpointError: the name could lead out of the folder, or is none.
        """
        suffix = SUFFIXES[kind]
        plain = name.removesuffix(suffix)
        if not _NAME.fullmatch(plain):
            raise CheckpointError(
                f"'{name[:100]}' is no name of a {kind}: give letters, digits, '_', '-' and '.'"
                f" only, no folder; it is a file in '{self.folder}'"
            )
        return self.folder / (plain + suffix)

    def write(self, name: str, saved: Checkpoint) -> Path:
        """Saves under a name, in the place of what had that name.

        Raises:
            CheckpointError: the name is unusable, or the file cannot be written.
        """
        path = self.path(name, saved.kind)
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            write_checkpoint(path, saved)
        except OSError as error:
            raise CheckpointError(f"'{path}' cannot be written: {error.strerror}") from error
        return path

    def read(self, name: str, kind: str) -> Checkpoint:
        """What is saved under a name; raises CheckpointError."""
        return read_checkpoint(self.path(name, kind))


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
