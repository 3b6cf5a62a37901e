"""A page that stands for itself: everything it needs is in it, and it may ask for nothing else."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from html import escape, unescape
from importlib import resources
from typing import Any

import numpy as np

from dopslam_ros.core.linalg.arrays import FloatArray
from dopslam_ros.lab.report.charts import Chart, Section
from dopslam_ros.lab.report.encoding import packed, script_digest, script_json

# Light and dark. Those of landmarks and sources are Okabe and Ito's, lighter where it is dark.
PALETTE = {
    "text": ("#1c2430", "#e4e9f0"),
    "soft": ("#5a6675", "#9aa7b6"),
    "card": ("#ffffff", "#19202a"),
    "grid": ("#e6eaf0", "#28323f"),
    "axis": ("#9aa5b3", "#55626f"),
    "band": ("rgba(120,130,145,0.18)", "rgba(150,165,185,0.18)"),
    "truth": ("#4a4f57", "#c3cad3"),
    "estimate": ("#c03030", "#ff7b72"),
    "halo": ("#e8a8a8", "#8a4743"),
    "bound": ("#2060a0", "#6cb2f0"),
    "los": ("#009e73", "#2fc89b"),
    "va": ("#0072b2", "#56b4e9"),
    "sp": ("#d98200", "#f5b041"),
    "new": ("#b4538f", "#e69ac6"),
    "clutter": ("#8d949e", "#7f8a97"),
}


class MissingLibrary(RuntimeError):
    """The plotting library is not there; the message says how to get it."""


def plotting_library() -> str:
    """The JavaScript of plotly.

    Raises:
        MissingLibrary: plotly is not installed.
    """
    try:
        from plotly.offline import get_plotlyjs
    except ImportError as error:
        raise MissingLibrary(
            "pages are drawn by plotly, which is not installed: apt install python3-plotly,"
            " or pip install 'plotly>=5.15'"
        ) from error
    return str(get_plotlyjs())


def page(
    title: str,
    body: str,
    data: Mapping[str, Any],
    columns: Mapping[str, FloatArray],
    charts: Iterable[Chart],
    scripts: Sequence[str],
) -> str:
    """The HTML of a page.

    Its security policy lets the scripts of this package run and nothing else, whatever texts a
    bag holds, and nothing be fetched from anywhere.

    Args:
        title: of the window.
        body: HTML.
        data: what the scripts need beside columns and charts.
        columns: numbers by name.
        charts: on the page.
        scripts: names of files in assets, in the order in which they run.
    """
    everything = {
        **data,
        "palette": PALETTE,
        "columns": packed(columns),
        "charts": [
            {
                "key": chart.key,
                "traces": chart.traces,
                "layout": chart.layout,
                "overTime": chart.over_time,
            }
            for chart in charts
        ],
    }
    code = [plotting_library(), *map(asset, scripts)]
    policy = (
        f"default-src 'none'; script-src {' '.join(map(script_digest, code))};"
        " style-src 'unsafe-inline'; img-src data: blob:"
    )
    return "\n".join(
        (
            '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">',
            f'<meta http-equiv="Content-Security-Policy" content="{policy}">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f"<title>{escape(title)}</title>",
            f"<style>{asset('page.css')}</style>",
            f"</head>\n<body>\n{body}",
            f'<script type="application/json" id="data">{script_json(everything)}</script>',
            *(f"<script>{text}</script>" for text in code),
            "</body>\n</html>\n",
        )
    )


def asset(name: str) -> str:
    """A file that comes with this package."""
    return (resources.files("dopslam_ros.lab.report") / "assets" / name).read_text("utf-8")


def time_range(time: FloatArray) -> list[float]:
    """What the charts show: half a step more than the run at both ends, for bars."""
    margin = 0.5 * float(np.median(np.diff(time))) if len(time) > 1 else 0.5
    return [float(time[0]) - margin, float(time[-1]) + margin]


# --- pieces of HTML ------------------------------------------------------------------------------


def section(found: Section, has_truth: bool = True) -> str:
    """A card with charts; without truth, where it is needed, with a word about that."""
    parts = [f"<h2>{escape(found.title)}</h2>", f'<p class="soft">{escape(found.text)}</p>']
    if found.needs_truth and not has_truth:
        parts.append('<p class="notice">This needs the truth, which is not in this bag.</p>')
    else:
        parts += _charts(found)
    return card(found.key, "".join(parts))


def _charts(found: Section) -> Iterator[str]:
    """The places of the charts; a title or a key that stands above already is not said again."""
    key = ""
    for chart in found.charts:
        if chart.title != found.title:
            yield f"<h3>{escape(chart.title)}</h3>"
        before, key = key, _key(chart)
        yield key if key != before else ""
        yield (
            f'<div class="plot"><div id="{escape(chart.key)}" role="img"'
            f' aria-label="{escape(chart.title)}"></div></div>'
        )


def _key(chart: Chart) -> str:
    """What the lines mean; of a single line the axis says it."""
    named = [t for t in chart.traces if t.get("name") and t.get("showlegend", True)]
    if len(named) < 2:
        return ""
    return '<div class="key">{}</div>'.format("".join(map(_key_entry, named)))


def _key_entry(trace: Mapping[str, Any]) -> str:
    line = trace.get("line", {})
    filled = trace["type"] == "bar" or "fillcolor" in trace
    colour = trace.get("fillcolor") or trace.get("marker", line)["color"]
    kind = "box" if filled else DASHES.get(line.get("dash", "solid"), "")
    return f"<span>{swatch(colour.removeprefix('$'), kind)}{escape(unescape(trace['name']))}</span>"


# Names of swatches by those of plotly's dashes.
DASHES = {"dash": "dashed", "dot": "dotted"}


def swatch(colour: str, kind: str = "") -> str:
    """A little piece of a colour of the palette."""
    return f'<i class="swatch {kind}" data-colour="{escape(colour)}"></i>'


def card(key: str, content: str) -> str:
    """A box."""
    return f'<section class="card" id="section-{escape(key)}">{content}</section>'


def notice(text: str) -> str:
    """Something to be aware of."""
    return f'<p class="notice" role="status">{escape(text)}</p>'


def tiles(numbers: Iterable[tuple[str, str, str]]) -> str:
    """The numbers that say most: value, what it is, what to compare it with."""
    return '<div class="tiles">{}</div>'.format(
        "".join(
            f'<div class="card tile"><b>{escape(value)}</b><span>{escape(name)}</span>'
            f"<small>{escape(small)}</small></div>"
            for value, name, small in numbers
        )
    )


def table(
    head: Sequence[str], rows: Iterable[Sequence[str]], kind: str = "", body: str = ""
) -> str:
    """A table of texts, with the id ``body`` of its rows if one is given."""
    cells = "".join(f"<th>{escape(name)}</th>" for name in head)
    lines = "".join(
        "<tr>{}</tr>".format("".join(f"<td>{escape(cell)}</td>" for cell in row)) for row in rows
    )
    name = f' id="{body}"' if body else ""
    return (
        f'<div class="scroll"><table class="{kind}"><thead><tr>{cells}</tr></thead>'
        f"<tbody{name}>{lines}</tbody></table></div>"
    )
