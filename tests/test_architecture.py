"""The rooms of the package, and which of them may know which."""

from __future__ import annotations

import ast
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import dopslam_ros

PACKAGE = Path(dopslam_ros.__file__).resolve().parent
# What each room may import beside itself. The laboratory and the command are known to none.
ROOMS = {
    "core": set(),
    "system": {"core"},
    "bag": set(),
    "messages": {"core", "bag"},
    "simulation": {"core", "messages", "bag", "system"},
    "nodes": {"core", "messages", "bag", "system", "simulation"},
    "offline": {"core", "messages", "bag", "system", "simulation"},
    "lab": {"core", "messages", "bag", "system", "simulation", "nodes", "offline"},
    "cli": {"core", "messages", "bag", "system", "simulation", "nodes", "offline", "lab"},
}
# The rooms of the core, from the ground up: each may know those before it.
CORE = (
    "linalg",
    "settings",
    "models",
    "association",
    "pmb",
    "pcrb",
    "monitoring",
    "session",
)


def modules() -> dict[str, Path]:
    """Every module of the package by its name."""
    found = {}
    for file in PACKAGE.rglob("*.py"):
        parts = ("dopslam_ros", *file.relative_to(PACKAGE).with_suffix("").parts)
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = file
    return found


MODULES = modules()


def imported(file: Path) -> set[str]:
    """The modules of the package that a file imports, at any depth."""
    found = set()
    for node in ast.walk(ast.parse(file.read_text("utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.level == 0:
            for alias in node.names:
                name = f"{node.module}.{alias.name}"
                found.add(name if name in MODULES else str(node.module))
        elif isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
    return {name for name in found if name.split(".")[0] == "dopslam_ros"}


def test_every_module_has_a_room() -> None:
    loose = {file.name for file in PACKAGE.glob("*.py")}
    assert loose == {"__init__.py"}
    assert {folder.parent.name for folder in PACKAGE.glob("*/__init__.py")} == set(ROOMS)
    core = {folder.parent.name for folder in (PACKAGE / "core").glob("*/__init__.py")}
    assert core == set(CORE)
    assert {file.name for file in (PACKAGE / "core").glob("*.py")} == {"__init__.py"}


@pytest.mark.parametrize("room", ROOMS)
def test_a_room_knows_no_other_than_it_may(room: str) -> None:
    for name, file in MODULES.items():
        if name.split(".")[1:2] == [room]:
            others = {other.split(".")[1] for other in imported(file) if "." in other}
            assert others <= ROOMS[room] | {room}, name


def test_the_core_is_built_from_the_ground_up() -> None:
    for name, file in MODULES.items():
        parts = name.split(".")
        if parts[1:2] != ["core"] or len(parts) < 3:
            continue
        below = {*CORE[: CORE.index(parts[2]) + 1]}
        for other in imported(file):
            assert other.split(".")[2] in below, f"{name} imports {other}"


def test_no_module_needs_itself() -> None:
    """Imports at the top of modules have an order."""
    graph = {}
    for name, file in MODULES.items():
        tree = ast.parse(file.read_text("utf-8"))
        at_top = {
            f"{node.module}.{alias.name}"
            if f"{node.module}.{alias.name}" in MODULES
            else str(node.module)
            for node in tree.body
            if isinstance(node, ast.ImportFrom)
            for alias in node.names
        }
        graph[name] = at_top & set(MODULES)
    assert list(TopologicalSorter(graph).static_order())
