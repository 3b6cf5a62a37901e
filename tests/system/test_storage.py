"""Maps on disk: names that stay in their folder, files that are whole, snapshots beside the run."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import pytest

from dopslam_ros.core.pmb import FilterParameters
from dopslam_ros.core.session.checkpoint import MAP, SNAPSHOT, CheckpointError
from dopslam_ros.core.session.checkpoint_file import to_bytes
from dopslam_ros.core.session.filtering import FilterSession
from dopslam_ros.system.snapshot_writer import SnapshotWriter
from dopslam_ros.system.storage import Store, write_checkpoint

SESSION = FilterSession(FilterParameters())


@pytest.fixture
def store(tmp_path: Path) -> Store:
    """A folder that is not there yet."""
    return Store(str(tmp_path / "maps"))


def test_what_is_written_is_read(store: Store) -> None:
    saved = SESSION.known_map()
    path = store.write("hall", saved)
    assert path == store.folder / "hall.dopmap"
    assert to_bytes(store.read("hall", MAP)) == to_bytes(store.read("hall.dopmap", MAP))
    assert path.read_bytes() == to_bytes(saved)
    store.write("hall", saved)
    assert [p.name for p in store.folder.iterdir()] == ["hall.dopmap"]


@pytest.mark.parametrize(
    "name",
    ["", "..", "../x", "a/b", "/etc/passwd", ".a", "a\0b", "a\nb", "~", "x" * 101, "ü", "a\\b"],
)
def test_a_name_cannot_lead_out_of_the_folder(store: Store, name: str) -> None:
    for act in (
        lambda: store.write(name, SESSION.known_map()),
        lambda: store.read(name, MAP),
        lambda: store.path(name, SNAPSHOT),
    ):
        with pytest.raises(CheckpointError, match="no name"):
            act()
    assert not store.folder.exists()


def test_links_are_not_followed(store: Store, tmp_path: Path) -> None:
    outside = tmp_path / "outside.dopmap"
    write_checkpoint(outside, SESSION.known_map())
    before = outside.read_bytes()
    store.folder.mkdir()
    link = store.folder / "link.dopmap"
    link.symlink_to(outside)
    with pytest.raises(CheckpointError, match="cannot be read"):
        store.read("link", MAP)
    planted = store.folder / "link.dopmap.tmp"
    planted.symlink_to(outside)
    store.write("link", replace(SESSION.known_map(), stamp_ns=7))
    assert outside.read_bytes() == before
    assert not link.is_symlink() and store.read("link", MAP).stamp_ns == 7


def test_what_is_no_file_is_refused_at_once(store: Store) -> None:
    store.folder.mkdir()
    os.mkfifo(store.folder / "pipe.dopmap")
    (store.folder / "folder.dopmap").mkdir()
    with (store.folder / "huge.dopmap").open("wb") as file:
        file.truncate(1 << 40)  # a hole: it takes no room on the disk
    for name in ("pipe", "folder", "huge", "nothing"):
        with pytest.raises(CheckpointError, match=f"{name}.dopmap' cannot be read"):
            store.read(name, MAP)


def test_a_folder_that_cannot_be_written_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    store = Store(str(tmp_path / "file"))
    with pytest.raises(CheckpointError, match="cannot be written"):
        store.write("hall", SESSION.known_map())
    with pytest.raises(CheckpointError, match="cannot be made"):
        SnapshotWriter(store, "last", 0.1)


def test_a_write_that_fails_leaves_the_old_file(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = store.write("hall", SESSION.known_map())
    before = path.read_bytes()

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(CheckpointError, match="No space left"):
        store.write("hall", replace(SESSION.known_map(), stamp_ns=9))
    assert path.read_bytes() == before
    assert [p.name for p in store.folder.iterdir()] == ["hall.dopmap"]
