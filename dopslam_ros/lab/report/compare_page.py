"""The page with cases beside each other."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from html import escape
from typing import Any

import numpy as np

from dopslam_ros.lab.report.charts import UNITS, Chart, Section, confidence_band, line, y_axis
from dopslam_ros.lab.report.comparison import Comparison
from dopslam_ros.lab.report.page import card, notice, page, section, table, time_range
from dopslam_ros.lab.study.table import Cells, result_cells

SCRIPTS = ("charts.js", "compare.js")
_COLOURS = ("$estimate", "$va", "$sp", "$los", "$new", "$soft")
_DASHES = ("solid", "dash", "dot")
_GOSPA = (
    ("va_distance", "walls (virtual anchors)"),
    ("sp_distance", "objects (scattering points)"),
)


def comparison_cells(summary: dict[str, Any]) -> Iterator[tuple[str, Cells]]:
    """The tables, with their titles."""
    rows = summary["rows"]
    milliseconds = [row["step_ms_p50"] for row in rows]
    for title, cells in result_cells(rows, milliseconds, ["case"], lambda row: [row["case"]]):
        yield title, _without_empty_columns(cells)


def _without_empty_columns(cells: Cells) -> Cells:
    """What no case has is no column: a bag does not say which association is true."""
    head, *rows = cells
    kept = [n for n in range(len(head)) if any(row[n] != "-" for row in rows)]
    return [[row[n] for n in kept] for row in cells]


def remarks(summary: dict[str, Any]) -> Iterator[str]:
    """What to know before the numbers are read."""
    runs = summary["runs"]
    low, high = summary["nees_band"]
    several = f"{runs} runs each" if runs > 1 else "a run each"
    yield f"{several}; at a step an honest NEES, over the runs, lies in {low:.2f} .. {high:.2f}"
    if runs > 1:
        yield f"in brackets: {summary['confidence']:.0%} of the bootstrap over runs"
    if not summary["same_drives"]:
        yield "these are different drives: their errors are beside each other, not subtracted"
    for row in summary["rows"]:
        for reason, count in sorted(row["problems"].items()):
            yield f"problem of {row['case']}: {reason}: {count}"
        yield from (f"damaged bag of {row['case']}: {text}" for text in row["damage"])


def compare_page(comparison: Comparison) -> str:
    """The HTML. Raises MissingLibrary: plotly is not installed."""
    summary, columns = comparison.summary, comparison.columns
    labels = [row["case"] for row in summary["rows"]]
    has_truth = bool(np.isfinite(columns["error_position_0"]).any())
    shown = [*_sections(labels, comparison, has_truth)]
    title = " – ".join(labels)
    tables = "".join(
        (f'<p class="soft">{escape(caption)}</p>' if caption else "") + table(cells[0], cells[1:])
        for caption, cells in comparison_cells(summary)
    )
    notices = "".join(
        notice(text) for text in ([] if has_truth else ["No truth in these bags: no errors."])
    )
    said = "".join(f'<p class="soft">{escape(text)}</p>' for text in remarks(summary))
    body = (
        f'<header><h1>{escape(title)}</h1><button id="theme" type="button">Dark</button>'
        f"<p>compared over {len(columns['time'])} steps that all have</p></header>"
        f"<main>{notices}{card('table', '<h2>In numbers</h2>' + said + tables)}"
        f'<div class="pairs">{"".join(section(one, has_truth) for one in shown)}</div></main>'
        "<footer>Drawn by plotly.js (MIT licence). A double click shows all of a chart again."
        "</footer>"
    )
    charts = [chart for one in shown if has_truth or not one.needs_truth for chart in one.charts]
    data = {"xTitle": "time [s]", "xRange": time_range(columns["time"])}
    return page(f"{title} – compared", body, data, columns, charts, SCRIPTS)


def _sections(labels: Sequence[str], comparison: Comparison, has_truth: bool) -> Iterator[Section]:
    yield Section(
        "accuracy",
        "Errors, root mean square over runs",
        "Dashed: the bound of each, with the measurements that it uses.",
        [_errors(size, labels) for size in UNITS],
        needs_truth=True,
    )
    if comparison.same_drives:
        yield Section(
            "differences",
            f"Errors less those of {labels[0]}",
            "Of the same measurements, so that luck cancels: below zero is better."
            + (
                f" The band holds the mean difference with {comparison.summary['confidence']:.0%}."
                if comparison.summary["runs"] > 1
                else ""
            ),
            [_differences(size, labels, comparison.summary["runs"]) for size in UNITS],
            needs_truth=True,
        )
    yield Section(
        "map",
        "Quality of the map",
        "GOSPA: the lower, the better placed and the more complete is the map.",
        [
            Chart(f"{column}", title.capitalize(), "", _lines(column, labels), y_axis("GOSPA [m]"))
            for column, title in _GOSPA
        ],
        needs_truth=True,
    )
    yield Section(
        "consistency",
        "Can the covariance be believed?",
        "NEES over the runs; nineteen of twenty steps should lie in the band.",
        [
            Chart(
                "nees",
                "NEES of the vehicle",
                "",
                [*confidence_band("nees"), *_lines("nees", labels)],
                y_axis("NEES (ideal 4)"),
            )
        ],
        needs_truth=True,
    )
    yield Section(
        "time",
        "Time of a step",
        "On the machine that made this page.",
        [
            Chart(
                "times",
                "Time of a step",
                "",
                _lines("milliseconds", labels),
                {"yaxis": {"title": {"text": "[ms]"}, "type": "log"}},
            )
        ],
    )
    yield Section("tracks", "Tracks of the first run", "From above.", [_tracks(labels, has_truth)])


def _look(number: int) -> dict[str, str]:
    return {
        "colour": _COLOURS[number % len(_COLOURS)],
        "dash": _DASHES[number // len(_COLOURS) % len(_DASHES)],
    }


def _lines(column: str, labels: Sequence[str]) -> list[dict[str, Any]]:
    return [
        line(f"{column}_{number}", escape(label), **_look(number))
        for number, label in enumerate(labels)
    ]


def _errors(size: str, labels: Sequence[str]) -> Chart:
    bounds = [
        line(
            f"bound_{size}_{number}",
            f"bound of {escape(label)}",
            _look(number)["colour"],
            dash="dash",
            width=1.2,
            showlegend=False,
        )
        for number, label in enumerate(labels)
    ]
    traces = [*_lines(f"error_{size}", labels), *bounds]
    return Chart(f"error-{size}", size.capitalize(), "", traces, y_axis(f"[{UNITS[size]}]"))


def _differences(size: str, labels: Sequence[str], runs: int) -> Chart:
    others = range(1, len(labels))
    bands = [trace for n in others for trace in _interval_band(size, n)] if runs > 1 else []
    lines = [line(f"less_{size}_{n}", escape(labels[n]), **_look(n)) for n in others]
    layout = {"yaxis": {"title": {"text": f"[{UNITS[size]}]"}, "zeroline": True}}
    return Chart(f"less-{size}", size.capitalize(), "", [*bands, *lines], layout)


def _interval_band(size: str, number: int) -> Iterable[dict[str, Any]]:
    """The interval of a mean difference."""
    look = _look(number)
    edge = {"width": 0, "hoverinfo": "skip", "showlegend": False}
    yield line(f"less_low_{size}_{number}", "", look["colour"], **edge)
    yield line(
        f"less_high_{size}_{number}",
        "",
        look["colour"],
        fill="tonexty",
        fillcolor=f"{look['colour']}~",
        **edge,
    )


def _tracks(labels: Sequence[str], has_truth: bool) -> Chart:
    traces = [line("true_y", "truth", "$truth", width=5, x="@true_x", opacity=0.35)]
    traces = traces if has_truth else []
    for number, label in enumerate(labels):
        look = _look(number)
        traces.append(line(f"y_{number}", escape(label), **look, x=f"@x_{number}"))
    layout = {
        "hovermode": "closest",
        "dragmode": "pan",
        "xaxis": {"title": {"text": "x [m]"}, "range": None, "autorange": True},
        "yaxis": {
            "title": {"text": "y [m]"},
            "scaleanchor": "x",
            "scaleratio": 1,
            "fixedrange": False,
        },
    }
    return Chart("tracks", "Tracks of the first run", "", traces, layout, over_time=False)
