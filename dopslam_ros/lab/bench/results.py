"""The results of several benchmarks, as a file keeps them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from dopslam_ros.lab.bench.records import Record, content_of, read_record
from dopslam_ros.system.errors import UsageError


class Results(NamedTuple):
    """What was measured on a machine.

    Attributes:
        machine: which one, and its software.
        quick: whether with few repetitions.
        records: of each benchmark.
    """

    machine: Mapping[str, Any]
    quick: bool
    records: list[Record]

    def content(self) -> dict[str, Any]:
        """The same as JSON takes it."""
        records = [content_of(record) for record in self.records]
        return {"machine": self.machine, "quick": self.quick, "records": records}


def read_results(path: Path) -> Results:
    """What ``dopslam bench --json`` wrote.

    Raises:
        UsageError: the file cannot be read or holds something else.
    """
    try:
        content = json.loads(path.read_text("utf-8"))
        records = [read_record(record) for record in content["records"]]
        return Results(dict(content["machine"]), bool(content["quick"]), records)
    except OSError as error:
        raise UsageError(f"--from {path}: {error.strerror}") from error
    except (ValueError, KeyError, TypeError) as error:
        raise UsageError(f"--from {path}: not what 'dopslam bench --json' writes") from error
