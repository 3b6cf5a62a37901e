"""A page that stands for itself: everything it needs is in it, and it may ask for nothing else."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from html import escape
from importlib import resources
from typing import Any

from dopslam_ros.core.arrays import FloatArray
from dopslam_ros.report.charts import Chart, Section
from dopslam_ros.report.encoding import packed, script_digest, script_json

# Light and dark. Those of landmarks and sources are Okabe and Ito's, lighter where it is dark.
PALETTE = {
    "text": ("#1c2430", "#e4e9f0"),
    "card": ("#ffffff", "#19202a"),
    "grid": ("#e6eaf0", "#28323f"),
    "axis": ("#9aa5b3", "#55626f"),
    "band": ("rgba(120,130,145,0.18)", "rgba(150,165,185,0.18)"),
    "truth": ("#4a4f57", "#c3cad3"),
    "estimate": ("#c03030", "#ff7b72"),
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
            {"key": chart.key, "traces": chart.traces, "layout": chart.layout} for chart in charts
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
    return (resources.files("dopslam_ros.report") / "assets" / name).read_text("utf-8")


# --- pieces of HTML ------------------------------------------------------------------------------


def section(found: Section, has_truth: bool = True) -> str:
    """A card with charts; without truth, where it is needed, with a word about that."""
    parts = [f"<h2>{escape(found.title)}</h2>", f'<p class="soft">{escape(found.text)}</p>']
    if found.needs_truth and not has_truth:
        parts.append('<p class="notice">This needs the truth, which is not in this bag.</p>')
    else:
        parts += [chart(one) for one in found.charts]
    return card(found.key, "".join(parts))


def chart(found: Chart) -> str:
    """The place of a chart under its title."""
    return (
        f'<h3>{escape(found.title)}</h3><div class="plot"><div id="{escape(found.key)}"'
        f' role="img" aria-label="{escape(found.title)}"></div></div>'
    )


def card(key: str, content: str) -> str:
    """A box."""
    return f'<section class="card" id="section-{escape(key)}">{content}</section>'


def notice(text: str) -> str:
    """Something to be aware of."""
    return f'<p class="notice" role="status">{escape(text)}</p>'


def tiles(numbers: Iterable[tuple[str, str, str]]) -> str:
    """The numbers that say most: value, small print behind it, what it is."""
    return '<div class="tiles">{}</div>'.format(
        "".join(
            f'<div class="card tile"><b>{escape(value)} <small>{escape(small)}</small></b>'
            f"<span>{escape(name)}</span></div>"
            for value, small, name in numbers
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
