"""The cache of the machine code."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from dopslam_ros.core.kernels import compiled as module
from dopslam_ros.core.kernels.compiled import cache_folder

COMPILES = """
import numpy as np
from dopslam_ros.core.kernels.small import cholesky
assert cholesky(np.eye(2), 2)
print(sum(cholesky.stats.cache_hits.values()))
"""


def test_a_second_process_finds_the_machine_code(tmp_path: Path) -> None:
    environment = {"NUMBA_CACHE_DIR": str(tmp_path), "PATH": "/usr/bin:/bin"}
    hits = [
        subprocess.run(
            [sys.executable, "-c", COMPILES],
            env=environment,
            capture_output=True,
            text=True,
            check=True,
        ).stdout.strip()
        for _ in range(2)
    ]
    assert hits == ["0", "1"]
    assert list(tmp_path.glob("kernels-*/**/*.nbi"))


def test_without_a_folder_to_write_to_it_compiles_all_the_same(tmp_path: Path) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("not a folder")
    environment = {"NUMBA_CACHE_DIR": str(blocked), "PATH": "/usr/bin:/bin"}
    done = subprocess.run(
        [sys.executable, "-c", COMPILES],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr


def test_the_folder_is_named_after_the_text_of_all_kernels(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copy = tmp_path / "kernels"
    shutil.copytree(Path(module.__file__).parent, copy)
    names = []
    for change in ("", "\n# a change in a function that others call\n"):
        with (copy / "small.py").open("a") as file:
            file.write(change)
        monkeypatch.setattr(module, "__file__", str(copy / "compiled.py"))
        cache_folder.cache_clear()
        names.append(cache_folder().name)
    cache_folder.cache_clear()
    assert names[0] != names[1]
