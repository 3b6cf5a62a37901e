"""The command ``dopslam bench``."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from dopslam_ros.cli.options import write_json
from dopslam_ros.core.settings.parameters import unknown_name
from dopslam_ros.lab.bench.machine import machine
from dopslam_ros.lab.bench.records import Measured, Record, content_of, read_record
from dopslam_ros.lab.bench.suite import measure
from dopslam_ros.lab.bench.table import markdown, text_table
from dopslam_ros.lab.bench.titles import TITLES
from dopslam_ros.system.errors import UsageError


class Result(NamedTuple):
    """What a run of the command found.

    Attributes:
        machine: where.
        quick: whether with few repetitions.
        records: of each benchmark.
    """

    machine: Mapping[str, Any]
    quick: bool
    records: list[Record]


def run(options: Any) -> int:
    """Measures, or reads what was measured; returns 1 if a benchmark failed.

    Raises:
        UsageError: it is asked wrongly.
        KeyboardInterrupt: Ctrl-C; what is done is kept and shown.
    """
    if options.source is not None:
        if options.only or options.quick or options.json is not None:
            raise UsageError("--from measures nothing: give no --only, --quick or --json with it")
        _show(read_result(options.source), options)
        return 0
    names = options.only or list(TITLES)
    for name in names:
        if name not in TITLES:
            raise UsageError(unknown_name("benchmark", name, list(TITLES)))
    result = Result(machine(), options.quick, [])
    failed = False
    try:
        for number, name in enumerate(names, start=1):
            _say(f"{number}/{len(names)} {name} ...")
            started = time.perf_counter()
            try:
                result.records.append(measure(name, options.quick))
            except Exception as error:  # does not take the others with it
                failed = True
                note = f"failed: {type(error).__name__}: {error}"
                result.records.append(Record(name, TITLES[name], Measured(notes=(note,))))
            _say(f" {time.perf_counter() - started:.1f} s\n")
    except KeyboardInterrupt:
        _say(" stopped\n")
        raise
    finally:
        _show(result, options)
    return 1 if failed else 0


def _say(text: str) -> None:
    print(text, end="", file=sys.stderr, flush=True)


def _show(result: Result, options: Any) -> None:
    """The table, and the files that were asked for."""
    print(text_table(result.records))
    if options.json is not None:
        write_json(
            options.json,
            {
                "machine": result.machine,
                "quick": result.quick,
                "records": [content_of(record) for record in result.records],
            },
        )
    if options.markdown is not None:
        text = markdown(result.records, result.machine, result.quick)
        options.markdown.write_text(text, "utf-8")


def read_result(path: Path) -> Result:
    """What ``--json`` wrote.

    Raises:
        UsageError: the file cannot be read or holds something else.
    """
    try:
        content = json.loads(path.read_text("utf-8"))
        records = [read_record(record) for record in content["records"]]
        return Result(dict(content["machine"]), bool(content["quick"]), records)
    except OSError as error:
        raise UsageError(f"--from {path}: {error.strerror}") from error
    except (ValueError, KeyError, TypeError) as error:
        raise UsageError(f"--from {path}: not what 'dopslam bench --json' writes") from error
