"""The summary of a study as a table to read."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
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
    times = {(row["filter"], row["doppler"]): row["step_ms_p50"] for row in timing}
    milliseconds = [times[row["filter"], row["doppler"]] for row in summary["rows"]]
    for title, cells in result_cells(summary["rows"], milliseconds, ["filter", "Doppler"], _name):
        yield ""
        if title:
            yield title
        yield from aligned(cells)


Cells = list[list[str]]


def result_cells(
    rows: Sequence[Row],
    milliseconds: Sequence[float],
    head: list[str],
    name: Callable[[Row], list[str]],
) -> Iterator[tuple[str, Cells]]:
    """What rows of ``summary.summary_rows`` say, as tables with their titles.

    Args:
        rows: the first is what the others are compared with.
        milliseconds: median time of a step of each.
        head: of the columns that name a row.
        name: what stands in these.
    """
    yield "", [head + _ACCURACY, *(name(row) + _accuracy(row) for row in rows)]
    yield (
        "",
        [
            head + _CONSISTENCY,
            *(name(r) + _consistency(r, ms) for r, ms in zip(rows, milliseconds, strict=True)),
        ],
    )
    compared = [row for row in rows if "to_first" in row]
    if compared:
        title = f"over those of {name(rows[0])[0]} on the same runs (below 1: better)"
        yield title, [head + _COMPARED, *(name(row) + _compared(row) for row in compared)]


_ACCURACY = [
    "position [m]",
    "over bound",
    "heading [deg]",
    "over bound",
    "clock [m]",
    "over bound",
]
_CONSISTENCY = ["NEES", "GOSPA VA [m]", "GOSPA SP [m]", "association", "step [ms]"]
_COMPARED = ["position", "heading", "clock", "GOSPA VA", "GOSPA SP"]


def _accuracy(row: Row) -> list[str]:
    cells = []
    names = ("position_rmse", "heading_rmse_deg", "clock_bias_rmse")
    for name, ratio in zip(names, ("position", "heading", "clock"), strict=True):
        cells += [_plain(row[name]), _bracketed(row[f"{ratio}_to_bound"])]
    return cells


def _consistency(row: Row, milliseconds: float) -> list[str]:
    numbers = (row["nees_mean"], row["gospa_va"], row["gospa_sp"])
    weight = _bracketed(row["correct_association_weight"], 3)
    return [*map(_bracketed, numbers), weight, f"{milliseconds:.2f}"]


def _compared(row: Row) -> list[str]:
    return [*map(_bracketed, row["to_first"].values())]


def _name(row: Row) -> list[str]:
    doppler = row["doppler"]
    return [row["filter"], "none" if doppler is None else f"{doppler:g} m/s"]


def _plain(found: Row) -> str:
    return "-" if math.isnan(found["value"]) else f"{found['value']:.4f}"


def _bracketed(found: Row, digits: int = 2) -> str:
    """A number with its interval; a dash where there is none."""
    if math.isnan(found["value"]):
        return "-"
    text = f"{found['value']:.{digits}f}"
    if math.isnan(found["low"]):
        return text
    return f"{text} [{found['low']:.{digits}f}, {found['high']:.{digits}f}]"


def aligned(lines: Cells) -> Iterator[str]:
    """Columns of one width, the first to the left."""
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    for first, *others in lines:
        cells = [f"{cell:>{width}}" for cell, width in zip(others, widths[1:], strict=True)]
        yield "  ".join([f"{first:{widths[0]}}", *cells])
