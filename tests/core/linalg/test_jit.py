"""The cache of the machine code."""

from __future__ import annotations

import ast
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from dopslam_ros.core.linalg import jit as module
from dopslam_ros.core.linalg.jit import cache_folder

COMPILES = """
import numpy as np
from dopslam_ros.core.linalg.jit import from_python
from dopslam_ros.core.linalg import small
cholesky = from_python(small.cholesky)
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


def test_nobody_calls_a_part_from_python() -> None:
    """It would crash the process: outside the kernels a part is from_python, or not mentioned."""
    kernels = Path(module.__file__).parent
    parts = {
        (file.stem, node.name)
        for file in kernels.glob("*.py")
        for node in ast.parse(file.read_text("utf-8")).body
        if isinstance(node, ast.FunctionDef)
        and {"part", "part_of_one"} & {getattr(mark, "id", "") for mark in node.decorator_list}
    }
    assert ("small", "cholesky") in parts
    root = kernels.parents[2]
    for file in [*root.glob("dopslam_ros/**/*.py"), *root.glob("tests/**/*.py")]:
        if file.parent != kernels:
            assert not parts & mentioned(ast.parse(file.read_text("utf-8"))), file


def mentioned(tree: ast.Module) -> set[tuple[str, str]]:
    """Kernels (module, name) that a text names anywhere but as the argument of ``from_python``."""
    package, found = module.__name__.rpartition(".")[0], set()
    modules: dict[str, str] = {}
    from_python = [
        node.args[0]
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "from_python"
    ]
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module == package:
            modules.update({alias.asname or alias.name: alias.name for alias in node.names})
        elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith(f"{package}."):
            inner = str(node.module).rpartition(".")[2]
            found.update((inner, alias.name) for alias in node.names)
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and node not in from_python:
            owner = modules.get(getattr(node.value, "id", ""))
            if owner is not None:
                found.add((owner, node.attr))
    return found
