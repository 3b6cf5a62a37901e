"""Maps and snapshots on disk: one folder, plain names, files that are whole or not there."""

from __future__ import annotations

import re
from functools import cached_property
from pathlib import Path

from dopslam_ros.core.session.checkpoint import MAP, SNAPSHOT, Checkpoint, CheckpointError
from dopslam_ros.core.session.checkpoint_file import MOST_BYTES, decode, encode
from dopslam_ros.system.files import read_bounded, write_whole

SUFFIXES = {MAP: ".dopmap", SNAPSHOT: ".dopstate"}
_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,99}")


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
