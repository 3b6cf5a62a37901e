"""The charts of a run, as plotly takes them.

In a chart "@name" stands for a column of the page's data, "$name" for a colour of its palette and
"$name~" for the same colour, faint: the page puts them in, and changes the colours with its theme.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

from dopslam_ros.lab.report.scene import NAMES, Source
from dopslam_ros.lab.report.series import CONFIDENCE


class Chart(NamedTuple):
    """A chart with the words around it.

    Attributes:
        key: its id on the page.
        title: what it shows.
        text: what is seen, and what is good.
        traces: as in plotly.
        layout: what differs from the layout that all charts have.
        over_time: whether x is the time, which all charts show the same piece of.
    """

    key: str
    title: str
    text: str
    traces: list[dict[str, Any]]
    layout: dict[str, Any]
    over_time: bool = True


class Section(NamedTuple):
    """Charts under one heading."""

    key: str
    title: str
    text: str
    charts: list[Chart]
    needs_truth: bool = False


UNITS = {"position": "m", "heading": "deg", "clock": "m"}
_PARTS = (
    ("distance", "GOSPA", "$halo", "solid", 5.0),
    ("localisation", "localisation", "$bound", "solid", 1.4),
    ("missed", "missed", "$sp", "dash", 1.4),
    ("false", "false", "$new", "dot", 1.8),
)
_KINDS = (("va", "Walls (virtual anchors)"), ("sp", "Objects (scattering points)"))
SOURCE_COLOURS = {
    Source.LOS: "$los",
    Source.VA: "$va",
    Source.SP: "$sp",
    Source.NEW: "$new",
    Source.CLUTTER: "$clutter",
}


def sections(has_truth: bool, has_bounds: bool) -> list[Section]:
    """All charts of a run."""
    return [
        Section(
            "accuracy",
            "Error against bound",
            "The bound is the least error any estimator can have on this drive."
            + (
                " Over a run the error should scatter about it, and the filter's own sigma lie on"
                " it."
                if has_truth
                else " Errors need the truth, which is not in this bag: the filter's own sigma"
                " should lie on the bound, here evaluated at the estimate."
            ),
            [_size(size, has_truth, has_bounds) for size in UNITS],
        ),
        Section(
            "map",
            "Quality of the map",
            "GOSPA in metres, and the roots of the parts whose squares add up to it: how badly the"
            " landmarks found are placed, those missed, those that are none (14 m for the first of"
            " each). Good is a distance that falls to its localisation part.",
            [_gospa(*kind) for kind in _KINDS],
            needs_truth=True,
        ),
        Section(
            "consistency",
            "Can the covariance be believed?",
            f"Nineteen of twenty steps should lie in the grey band ({CONFIDENCE:.0%}). Above it the"
            " filter is surer than it may be, below it more modest than it need be.",
            _consistency(has_truth),
        ),
        Section(
            "association",
            "Which path came from where",
            "What the filter took the paths for, and how sure it was: good is a best association"
            " with nearly all of the weight.",
            [_sources(), _weights()],
        ),
        Section(
            "time",
            "Time of a step",
            "On the machine that made this report. It must stay below the time between two sets.",
            [_times()],
        ),
    ]


def line(column: str, name: str, colour: str, **more: Any) -> dict[str, Any]:
    """A column over time; ``width``, ``dash`` and what else a trace may have."""
    look = {"color": colour, "width": more.pop("width", 1.6), "dash": more.pop("dash", "solid")}
    return {
        "type": "scatter",
        "mode": "lines",
        "x": "@time",
        "y": f"@{column}",
        "name": name,
        "line": look,
        **more,
    }


def y_axis(title: str, **more: Any) -> dict[str, Any]:
    """A layout with a y axis that begins at zero."""
    return {"yaxis": {"title": {"text": title}, "rangemode": "tozero", **more}}


def _size(key: str, has_truth: bool, has_bounds: bool) -> Chart:
    traces = []
    if has_truth:
        traces.append(line(f"error_{key}", "error", "$estimate", width=1.3))
    traces.append(line(f"sigma_{key}", "filter's sigma", "$estimate", dash="dot"))
    if has_bounds:
        traces += [
            line(f"bound_{key}", "bound", "$bound", width=2.2),
            line(f"plain_bound_{key}", "bound without Doppler", "$bound", dash="dash"),
        ]
    return Chart(f"error-{key}", key.capitalize(), "", traces, y_axis(f"[{UNITS[key]}]"))


def _gospa(key: str, title: str) -> Chart:
    traces = [
        line(f"{key}_{part}", name, colour, dash=dash, width=width)
        for part, name, colour, dash, width in _PARTS
    ]
    return Chart(f"gospa-{key}", title, "", traces, y_axis("[m]"))


def confidence_band(name: str) -> Iterable[dict[str, Any]]:
    """Where a number should be, between its columns ``_low`` and ``_high``."""
    edge = {"width": 0, "hoverinfo": "skip"}
    yield line(f"{name}_low", "", "$band", showlegend=False, **edge)
    yield line(
        f"{name}_high", f"{CONFIDENCE:.0%} band", "$band", fill="tonexty", fillcolor="$band", **edge
    )


def _dots(column: str, name: str, colour: str) -> dict[str, Any]:
    dots = line(column, name, colour, width=0.8)
    return dots | {"mode": "lines+markers", "marker": {"color": colour, "size": 4}}


def _consistency(has_truth: bool) -> list[Chart]:
    nis = Chart(
        "nis",
        "NIS: paths against what the filter foresaw, over its degrees of freedom",
        "",
        [*confidence_band("nis"), _dots("nis", "NIS / dof", "$estimate")],
        y_axis("NIS / dof"),
    )
    if not has_truth:
        return [nis]
    nees = Chart(
        "nees",
        "NEES of the vehicle: error against its own covariance",
        "",
        [*confidence_band("nees"), _dots("nees", "NEES", "$estimate")],
        y_axis("NEES (ideal 4)"),
    )
    return [nees, nis]


def _sources() -> Chart:
    traces = [
        {
            "type": "bar",
            "x": "@time",
            "y": f"@count_{source.name.lower()}",
            "name": NAMES[source],
            "marker": {"color": SOURCE_COLOURS[source], "line": {"width": 0}},
        }
        for source in Source
    ]
    return Chart("sources", "Paths of a set", "", traces, y_axis("paths") | {"barmode": "stack"})


def _weights() -> Chart:
    shares = (
        ("weight_best", "best", "$bound"),
        ("weight_second", "second", "$sp"),
        ("weight_rest", "all others", "$clutter"),
    )
    traces = [
        line(column, name, colour, width=0.5, stackgroup="weights", fillcolor=colour)
        for column, name, colour in shares
    ]
    return Chart(
        "weights", "Weight of the associations", "", traces, y_axis("weight", range=[0, 1])
    )


def _times() -> Chart:
    trace = line("milliseconds", "step", "$bound", width=1.0)
    layout = {"yaxis": {"title": {"text": "[ms]"}, "type": "log"}}
    return Chart("times", "Time of a step", "", [trace], layout)
