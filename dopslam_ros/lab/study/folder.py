"""The folder of a study: its plan, and a file for each task that is done.

Whatever kills the process, what was written stays, and the same command goes on from there.
"""

from __future__ import annotations

import io
import json
import zipfile
import zlib
from pathlib import Path
from urllib.parse import quote

import numpy as np

from dopslam_ros.lab.study.plan import (
    Plan,
    StudyError,
    Task,
    differences,
    doppler_name,
    parse_plan,
    plan_content,
)
from dopslam_ros.lab.study.run import FIELDS, Part
from dopslam_ros.system.files import json_text, write_whole

PLAN = "plan.json"
PARTS = "parts"
# What readers of a damaged archive raise.
_UNREADABLE = (
    ValueError,
    KeyError,
    EOFError,
    OSError,
    NotImplementedError,
    RuntimeError,
    zipfile.BadZipFile,
    zlib.error,
)
# A folder may grow in these; in all else it is one study.
GROWING = ("filters", "dopplers", "runs")


class DamagedPart(StudyError):
    """The file of a task cannot be used."""


def open_folder(folder: Path, plan: Plan) -> None:
    """Makes the folder of a study, or goes on with the one that is there.

    Raises:
        StudyError: it holds another study, or something else.
        OSError: it cannot be written.
    """
    content = json.loads(json_text(plan_content(plan)))
    if (folder / PLAN).exists():
        there = {**_read_json(folder / PLAN), **{name: content[name] for name in GROWING}}
        different = differences(content, there)
        if different:
            raise StudyError(
                f"'{folder}' holds another study: {'; '.join(different[:5])}. Give another --out,"
                " or ask for the same"
            )
    elif folder.is_dir() and any(folder.iterdir()):
        raise StudyError(f"'{folder}' is not empty and holds no study: give another --out")
    folder.mkdir(parents=True, exist_ok=True)
    write_whole(folder / PLAN, json_text(plan_content(plan)).encode())


def read_plan(folder: Path) -> Plan:
    """The study that a folder holds.

    Raises:
        StudyError: it holds none.
    """
    if not (folder / PLAN).is_file():
        raise StudyError(f"'{folder}' holds no study: it has no {PLAN}")
    return parse_plan(_read_json(folder / PLAN))


def write_part(folder: Path, task: Task, part: Part) -> None:
    """Keeps what a task gave.

    Raises:
        OSError: it cannot be written.
    """
    path = part_path(folder, task)
    path.parent.mkdir(parents=True, exist_ok=True)
    content = io.BytesIO()
    np.savez(content, table=part.table, seconds=part.seconds)
    write_whole(path, content.getvalue())


def read_part(folder: Path, task: Task, steps: int) -> Part | None:
    """What a task gave; None if it is not done.

    Raises:
        DamagedPart: the file cannot be read, or is not of this study.
    """
    path = part_path(folder, task)
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        return None
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            broken = archive.testzip()
        if broken is not None:
            raise ValueError(f"{broken} has a wrong checksum")
        with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
            part = Part(arrays["table"], arrays["seconds"])
        shapes = part.table.shape, part.seconds.shape
        if shapes != ((steps, len(FIELDS)), (steps,)):
            raise ValueError(f"its arrays have the shapes {shapes}")
    except _UNREADABLE as error:
        raise DamagedPart(f"'{path}' is damaged: {error}") from error
    return part


def part_path(folder: Path, task: Task) -> Path:
    """The file of a task."""
    place = folder / PARTS / quote(task.filter, safe="=,") / doppler_name(task.doppler)
    return place / f"run{task.run:05d}.npz"


def _read_json(path: Path) -> dict[str, object]:
    try:
        content = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise StudyError(f"'{path}' cannot be read: {error}") from error
    if not isinstance(content, dict):
        raise StudyError(f"'{path}' is not the plan of a study")
    return content
