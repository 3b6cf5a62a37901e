"""The cache of the machine code."""

from __future__ import annotations

import ast
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from dopslam_ros.core.linalg import jit as module
from dopslam_ros.core.linalg.jit import cache_folder, kernel_sources

CORE = Path(module.__file__).resolve().parents[1]

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
    copy = tmp_path / "core"
    shutil.copytree(CORE, copy)
    names = []
    for change in ("", "\n# a change in a function that others call\n"):
        with (copy / "linalg" / "small.py").open("a") as file:
            file.write(change)
        monkeypatch.setattr(module, "__file__", str(copy / "linalg" / "jit.py"))
        cache_folder.cache_clear()
        names.append(cache_folder().name)
    cache_folder.cache_clear()
    assert names[0] != names[1]


def test_nothing_but_compiled_code_calls_a_jit_function() -> None:
    """It would crash the process: elsewhere it is an argument of ``from_python``, or not named."""
    inner = {
        (dotted(file), node.name)
        for file in kernel_sources()
        for node in ast.parse(file.read_text("utf-8")).body
        if marks(node) & {"jit", "jit_inline"}
    }
    assert ("dopslam_ros.core.linalg.small", "cholesky") in inner
    root = CORE.parents[1]
    for file in [*root.glob("dopslam_ros/**/*.py"), *root.glob("tests/**/*.py")]:
        assert not inner & mentioned(file), file


def dotted(file: Path) -> str:
    """The module of a file of the package."""
    return ".".join(file.relative_to(CORE.parents[1]).with_suffix("").parts)


def marks(node: ast.AST) -> set[str]:
    """The names of a function's decorators."""
    return {getattr(mark, "id", "") for mark in getattr(node, "decorator_list", ())}


def mentioned(file: Path) -> set[tuple[str, str]]:
    """Functions (module, name) named outside compiled code, but as argument of ``from_python``."""
    tree = ast.parse(file.read_text("utf-8"))
    modules: dict[str, str] = {}
    functions = {node.name: (dotted(file), node.name) for node in tree.body if marks(node)}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            for alias in node.names:
                modules[alias.asname or alias.name] = f"{node.module}.{alias.name}"
                functions[alias.asname or alias.name] = (str(node.module), alias.name)
    outside = [
        node
        for top in tree.body
        if not marks(top) & {"jit", "jit_inline", "from_python"}
        for node in ast.walk(top)
    ]
    allowed = [
        node.args[0]
        for node in outside
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "from_python"
    ]
    found = set()
    for node in outside:
        if node in allowed:
            continue
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load):
            found.add(functions.get(node.id, ("", node.id)))
        elif isinstance(node, ast.Attribute):
            found.add((modules.get(getattr(node.value, "id", ""), ""), node.attr))
    return found
