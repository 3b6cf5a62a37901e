"""Snapshots beside the run: the newest one, whatever the disk does."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from dopslam_ros.core.pmb import FilterParameters
from dopslam_ros.core.session.checkpoint import SNAPSHOT, Checkpoint, CheckpointError
from dopslam_ros.core.session.filtering import FilterSession
from dopslam_ros.system.snapshot_writer import SnapshotWriter
from dopslam_ros.system.storage import Store, read_checkpoint

SESSION = FilterSession(FilterParameters())
Wait = Callable[..., None]


@pytest.fixture
def store(tmp_path: Path) -> Store:
    """A folder that is not there yet."""
    return Store(str(tmp_path / "maps"))


def test_snapshots_follow_the_newest_offer(store: Store, wait: Wait) -> None:
    writer = SnapshotWriter(store, "last", 0.05)

    def numbered(stamp: int) -> Checkpoint:
        return replace(SESSION.snapshot(), stamp_ns=stamp)

    for stamp in range(200):
        writer.offer(numbered(stamp))
        time.sleep(0.001)
    path = store.path("last", SNAPSHOT)
    wait(lambda: path.exists() and read_checkpoint(path).stamp_ns == 199)
    assert 1 < writer.written < 100, "one per period, not one per offer"
    writer.offer(numbered(200))
    writer.offer(numbered(201))
    writer.close()
    assert read_checkpoint(path).stamp_ns == 201


def test_a_disk_that_is_full_for_a_while_is_told_and_survived(
    store: Store, wait: Wait, monkeypatch: pytest.MonkeyPatch
) -> None:
    writer = SnapshotWriter(store, "last", 0.01)

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        writer.offer(SESSION.snapshot())
        wait(lambda: writer.failed)
        assert writer.problem is not None and "No space left" in writer.problem
    writer.offer(SESSION.snapshot())
    wait(lambda: writer.written)
    assert writer.problem is None
    writer.close()


def test_two_filters_cannot_write_the_same_snapshot(store: Store) -> None:
    first = SnapshotWriter(store, "last", 0.1)
    with pytest.raises(CheckpointError, match="another filter"):
        SnapshotWriter(store, "last", 0.1)
    SnapshotWriter(store, "other", 0.1).close()
    first.close()
    SnapshotWriter(store, "last", 0.1).close()
