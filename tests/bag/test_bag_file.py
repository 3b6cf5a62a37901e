"""The file of a bag: who writes does not wait for the disk."""

from __future__ import annotations

import errno
import os
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from dopslam_ros.bag.file import BagFile


def test_writing_goes_on_while_the_disk_is_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is flushed meanwhile can be read: it is with the operating system."""
    waiting, go_on = threading.Event(), threading.Event()

    def slow(descriptor: int) -> None:
        waiting.set()
        assert go_on.wait(60.0)

    monkeypatch.setattr(os, "fsync", slow)
    file = BagFile(tmp_path / "bag", fsync_seconds=0.001)
    assert waiting.wait(60.0)
    for group in (b"one", b"two"):
        file.write(group)
        file.flush()
    assert (tmp_path / "bag").read_bytes() == b"onetwo"
    go_on.set()
    file.close()
    file.close()


def test_a_disk_that_cannot_store_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, wait: Callable[..., None]
) -> None:
    """At the next flush, with the error that the disk gave."""

    def broken(descriptor: int) -> None:
        raise OSError(errno.EIO, "the disk is broken")

    monkeypatch.setattr(os, "fsync", broken)
    file = BagFile(tmp_path / "bag", fsync_seconds=0.001)

    def refused() -> bool:
        try:
            file.flush()
        except OSError as error:
            return "the disk is broken" in str(error)
        return False

    wait(refused)
    file.close()
