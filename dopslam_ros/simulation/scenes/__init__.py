"""The scenes that come with the package, a YAML file each."""

from __future__ import annotations

from pathlib import Path

_FOLDER = Path(__file__).parent


def builtin_scenarios() -> list[str]:
    """Their names."""
    return sorted(file.stem for file in _FOLDER.glob("*.yaml"))


def builtin_text(name: str) -> str:
    """The YAML of one."""
    return (_FOLDER / f"{name}.yaml").read_text("utf-8")
