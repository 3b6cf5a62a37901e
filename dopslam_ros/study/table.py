"""The summary of a study as a table to read."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

Row = dict[str, Any]


def study_table(summary: Row, timing: list[Row]) -> Iterator[str]:
    """The lines of the table.

    Args:
        summary: of ``summary.summarise_study``.
        timing: of ``outputs.timing``.
    """
    planned = summary["runs_planned"]
    runs = str(planned) if summary["runs"] == planned else f"{summary['runs']} of {planned}"
    low, high = summary["nees_band"]
    yield (
        f"scene '{summary['scenario']}', {runs} runs of {summary['steps']} steps,"
        f" seed {summary['seed']}"
    )
    yield (
        f"in brackets: {summary['confidence']:.0%} of the bootstrap over runs;"
        f" an honest NEES lies in {low:.2f} .. {high:.2f}"
    )
    first = summary["rows"][0]["filter"]
    times = {(row["filter"], row["doppler"]): row["step_ms_p50"] for row in timing}
    accuracy, consistency = [_HEAD_ACCURACY], [_HEAD_CONSISTENCY]
    for row in summary["rows"]:
        accuracy.append(_accuracy(row))
        consistency.append(_consistency(row, times[row["filter"], row["doppler"]]))
    yield ""
    yield from _aligned(accuracy)
    yield ""
    yield from _aligned(consistency)
    compared = [row for row in summary["rows"] if "to_first" in row]
    if compared:
        yield ""
        yield f"over those of {first} on the same runs (below 1: better)"
        yield from _aligned([_HEAD_COMPARED, *map(_compared, compared)])


_HEAD_ACCURACY = [
    "filter",
    "Doppler",
    "position [m]",
    "over bound",
    "heading [deg]",
    "over bound",
    "clock [m]",
    "over bound",
]
_HEAD_CONSISTENCY = [
    "filter",
    "Doppler",
    "NEES",
    "GOSPA VA [m]",
    "GOSPA SP [m]",
    "association",
    "step [ms]",
]
_HEAD_COMPARED = ["filter", "Doppler", "position", "heading", "clock", "GOSPA VA", "GOSPA SP"]


def _accuracy(row: Row) -> list[str]:
    cells = _name(row)
    names = ("position_rmse", "heading_rmse_deg", "clock_bias_rmse")
    for name, ratio in zip(names, ("position", "heading", "clock"), strict=True):
        cells += [_plain(row[name]), _bracketed(row[f"{ratio}_to_bound"])]
    return cells


def _consistency(row: Row, milliseconds: float) -> list[str]:
    numbers = (row["nees_mean"], row["gospa_va"], row["gospa_sp"])
    weight = _bracketed(row["correct_association_weight"], 3)
    return [*_name(row), *map(_bracketed, numbers), weight, f"{milliseconds:.2f}"]


def _compared(row: Row) -> list[str]:
    return [*_name(row), *map(_bracketed, row["to_first"].values())]


def _name(row: Row) -> list[str]:
    doppler = row["doppler"]
    return [row["filter"], "none" if doppler is None else f"{doppler:g} m/s"]


def _plain(found: Row) -> str:
    return f"{found['value']:.4f}"


def _bracketed(found: Row, digits: int = 2) -> str:
    """A number with its interval; a dash where there is none."""
    if math.isnan(found["value"]):
        return "-"
    text = f"{found['value']:.{digits}f}"
    if math.isnan(found["low"]):
        return text
    return f"{text} [{found['low']:.{digits}f}, {found['high']:.{digits}f}]"


def _aligned(lines: list[list[str]]) -> Iterator[str]:
    """Columns of one width, the first to the left."""
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    for first, *others in lines:
        cells = [f"{cell:>{width}}" for cell, width in zip(others, widths[1:], strict=True)]
        yield "  ".join([f"{first:{widths[0]}}", *cells])
