"""``dopslam bench``: speed and memory."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dopslam_ros.cli.options import add_json, add_list, write_json
from dopslam_ros.lab.bench.titles import TITLES
from dopslam_ros.system.errors import UsageError

if TYPE_CHECKING:
    from dopslam_ros.lab.bench.records import Record
    from dopslam_ros.lab.bench.results import Results

TEXT = "measure speed and memory, beside what they compare with"
EXAMPLE = "dopslam bench --json bench.json --markdown BENCHMARKS.md"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of the command."""
    parser.add_argument(
        "--only", nargs="+", metavar="NAME", help="these benchmarks alone (default: all)"
    )
    parser.add_argument(
        "--quick", action="store_true", help="few repetitions: rough figures within minutes"
    )
    parser.add_argument(
        "--from",
        dest="source",
        type=Path,
        metavar="F",
        help="measure nothing, show what --json wrote into this file",
    )
    parser.add_argument(
        "--markdown", type=Path, metavar="F", help="file for the result as a document"
    )
    add_json(parser)
    add_list(parser, "benchmarks", TITLES)


def run(options: Any) -> int:
    """Measures, or reads what was measured; returns 1 if a benchmark failed.

    Raises:
        UsageError: it is asked wrongly.
        KeyboardInterrupt: Ctrl-C; what is done is kept and shown.
    """
    from dopslam_ros.core.settings.parameters import unknown_name
    from dopslam_ros.lab.bench.machine import machine
    from dopslam_ros.lab.bench.results import Results, read_results

    if options.source is not None:
        if options.only or options.quick or options.json is not None:
            raise UsageError("--from measures nothing: give no --only, --quick or --json with it")
        _show(read_results(options.source), options)
        return 0
    names = options.only or list(TITLES)
    for name in names:
        if name not in TITLES:
            raise UsageError(unknown_name("benchmark", name, list(TITLES)))
    results = Results(machine(), options.quick, [])
    try:
        failed = _measure(names, options.quick, results.records)
    except KeyboardInterrupt:
        _say(" stopped\n")
        raise
    finally:
        _show(results, options)
    return 1 if failed else 0


def _measure(names: list[str], quick: bool, records: list[Record]) -> bool:
    """Adds a record of each benchmark; returns whether one failed."""
    from dopslam_ros.lab.bench.records import Measured, Record
    from dopslam_ros.lab.bench.suite import measure

    failed = False
    for number, name in enumerate(names, start=1):
        _say(f"{number}/{len(names)} {name} ...")
        started = time.perf_counter()
        try:
            records.append(measure(name, quick))
        except Exception as error:  # does not take the others with it
            failed = True
            note = f"failed: {type(error).__name__}: {error}"
            records.append(Record(name, TITLES[name], Measured(notes=(note,))))
        _say(f" {time.perf_counter() - started:.1f} s\n")
    return failed


def _say(text: str) -> None:
    print(text, end="", file=sys.stderr, flush=True)


def _show(results: Results, options: Any) -> None:
    """The table, and the files that were asked for."""
    from dopslam_ros.lab.bench.table import markdown, text_table

    print(text_table(results.records))
    write_json(options.json, results.content())
    if options.markdown is not None:
        options.markdown.write_text(markdown(results), "utf-8")
