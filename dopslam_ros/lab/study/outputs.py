"""The files that a study leaves beside its parts.

Those with numbers are the same bytes for the same plan, whoever computed it and in how many goes;
times are in a file of their own.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dopslam_ros.core.linalg.arrays import FloatArray
from dopslam_ros.lab.study.plan import doppler_name
from dopslam_ros.lab.study.results import Case, Results
from dopslam_ros.lab.study.run import FIELDS, Outcome
from dopslam_ros.system.files import json_text, write_whole

FAILURES = "failures.txt"


def write_outputs(
    folder: Path, results: Results, summary: dict[str, Any], seconds: Mapping[Case, FloatArray]
) -> None:
    """Writes summary.json, summary.csv, steps.csv and timing.json.

    Raises:
        OSError: they cannot be written.
    """
    write_whole(folder / "summary.json", json_text(summary).encode())
    write_whole(folder / "summary.csv", _csv(summary_lines(summary)))
    write_whole(folder / "steps.csv", _csv(_step_lines(results)))
    write_whole(folder / "timing.json", json_text({"rows": timing(seconds)}).encode())


def write_failures(folder: Path, failed: Sequence[Outcome]) -> None:
    """Writes failures.txt with the traces of what failed; without failures there is no such file.

    Raises:
        OSError: it cannot be written.
    """
    if failed:
        text = "\n".join(f"{outcome.task}\n{outcome.error}" for outcome in failed)
        write_whole(folder / FAILURES, text.encode())
    else:
        (folder / FAILURES).unlink(missing_ok=True)


def timing(seconds: Mapping[Case, FloatArray]) -> list[dict[str, Any]]:
    """How long steps took, by filter and Doppler noise."""
    return [
        {
            "filter": label,
            "doppler": doppler,
            "steps": len(times),
            "step_ms_p50": float(np.percentile(times, 50)) * 1e3,
            "step_ms_p99": float(np.percentile(times, 99)) * 1e3,
        }
        for (label, doppler), times in seconds.items()
    ]


def summary_lines(summary: dict[str, Any]) -> Iterable[list[str]]:
    """The rows of the summary as a table: value, low and high of each number."""
    rows = [_flat(row) for row in summary["rows"]]
    names = list(dict.fromkeys(name for row in rows for name in row))
    yield names
    for row in rows:
        yield [row.get(name, "") for name in names]


def _flat(row: dict[str, Any]) -> dict[str, str]:
    cells = {"filter": row["filter"], "doppler": doppler_name(row["doppler"])}
    numbers = {name: found for name, found in row.items() if name not in (*cells, "to_first")}
    for name, found in row.get("to_first", {}).items():
        numbers[f"{name}_to_first"] = found
    for name, found in numbers.items():
        cells[name] = _number(found["value"])
        cells[f"{name}_low"] = _number(found["low"])
        cells[f"{name}_high"] = _number(found["high"])
    return cells


def _step_lines(results: Results) -> Iterable[list[str]]:
    """One line for every filter, Doppler noise, run and step (from 1 on)."""
    yield ["filter", "doppler", "run", "step", *FIELDS]
    for (label, doppler), table in results.tables.items():
        for run, rows in zip(results.run_numbers, table.tolist(), strict=True):
            begin = [label, doppler_name(doppler), str(run)]
            for step, row in enumerate(rows, start=1):
                yield [*begin, str(step), *map(_number, row)]


def _number(value: float) -> str:
    """Every digit; nothing where there is no number."""
    return "" if math.isnan(value) else repr(value)


def _csv(lines: Iterable[list[str]]) -> bytes:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(lines)
    return text.getvalue().encode()
