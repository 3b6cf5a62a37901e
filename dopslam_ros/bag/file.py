"""The file of a bag while it is written: whole groups of bytes or none, and the disk made sure."""

from __future__ import annotations

import os
import threading
from pathlib import Path

from dopslam_ros.bag.errors import BagExistsError, BagWriteError


class BagFile:
    """End of a file to which bytes are added in whole groups, or not at all.

    What is flushed is with the operating system. That the disk stores it too is waited for in a
    thread: it may take seconds, in which the one who writes goes on.

    Args:
        path: of the file, which must not exist.
        fsync_seconds: how often the disk is made to store everything [s]; None: only by ``sync``.
    """

    def __init__(self, path: Path, fsync_seconds: float | None = None) -> None:
        self.name = path.name
        self.pending = bytearray()
        self._size = 0
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_CLOEXEC", 0)
        self._descriptor = os.open(path, flags, 0o644)
        self._closing = threading.Event()
        self._refused: OSError | None = None
        self._thread: threading.Thread | None = None
        if fsync_seconds is not None:
            self._thread = threading.Thread(
                target=self._keep_syncing, args=(fsync_seconds,), name="fsync", daemon=True
            )
            self._thread.start()

    def write(self, data: bytes) -> int:
        """Add bytes to the group."""
        self.pending += data
        return len(data)

    def tell(self) -> int:
        """Offset of the next byte."""
        return self._size + len(self.pending)

    def flush(self) -> None:
        """Write the group; when the disk refuses, the file stays as it was before the group.

        Raises:
            OSError: the disk refused this group, or to store an earlier one.
        """
        if self._refused is not None:
            raise self._refused
        rest = memoryview(bytes(self.pending))
        self.pending.clear()
        try:
            while rest:
                rest = rest[os.write(self._descriptor, rest) :]
        except OSError:
            os.ftruncate(self._descriptor, self._size)
            raise
        self._size = os.lseek(self._descriptor, 0, os.SEEK_CUR)

    def sync(self) -> None:
        """Wait until the disk has stored everything. Raises OSError."""
        os.fsync(self._descriptor)

    def close(self) -> None:
        """Close the file. Doing so again changes nothing."""
        if self._closing.is_set():
            return
        self._closing.set()
        if self._thread is not None:
            self._thread.join()
        os.close(self._descriptor)

    def _keep_syncing(self, period: float) -> None:
        while not self._closing.wait(period):
            try:
                self.sync()
            except OSError as error:
                self._refused = error
                return


def create_file(bag: Path, fsync_seconds: float | None) -> BagFile:
    """Create the folder of a bag and its file.

    Raises:
        BagExistsError: the folder exists.
        BagWriteError: it cannot be created.
    """
    try:
        bag.mkdir(parents=True)
        return BagFile(bag / f"{bag.name}_0.mcap", fsync_seconds)
    except FileExistsError as error:
        raise BagExistsError(
            f"'{bag}' exists already and is not overwritten: choose another name, or move it away"
        ) from error
    except (OSError, ValueError) as error:
        raise BagWriteError(f"bag '{bag}' cannot be created: {error}") from error
