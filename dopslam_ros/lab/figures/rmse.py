"""The figure of the errors: a bar for each filter, with a mark at the bound."""

from __future__ import annotations

from typing import Any, NamedTuple

from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke

from dopslam_ros.lab.figures import numbers
from dopslam_ros.lab.figures.numbers import QUANTITIES
from dopslam_ros.lab.figures.panels import grid, legend
from dopslam_ros.lab.figures.style import (
    COMPARED,
    LOOKS,
    PUBLISHED,
    Look,
    condition,
    doppler_colours,
    looks,
    of_kinds,
)
from dopslam_ros.lab.study.results import Results
from dopslam_ros.offline.metrics import Rmse

# Of the bound on a bar: black, with a white rim on dark bars.
MARK: dict[str, Any] = {
    "color": "black",
    "lw": 2.0,
    "path_effects": [withStroke(linewidth=4.0, foreground="white")],
}
# The length of a bar that runs out of its panel is written on it.
OUTSIDE: dict[str, Any] = {
    "va": "center",
    "fontsize": 8.5,
    "bbox": {"facecolor": "white", "edgecolor": "none", "pad": 1.0},
}


def rmse_bars(results: Results) -> Figure:
    """Bars of the RMSE over all steps and runs, each with a mark at the bound."""
    bars, cases = _bars(results), numbers.cases(results)
    rows = list(dict.fromkeys(bar.look for bar in bars))
    thick, colours = 0.8 / len(cases), doppler_colours(len(cases))
    figure, panels = grid(1, len(QUANTITIES), 1.2 + 0.22 * len(rows) * len(cases), "all")
    for place, (axes, quantity) in enumerate(zip(panels[0], QUANTITIES, strict=True)):
        limit = 1.35 * _longest(bars, place)
        for bar in bars:
            case = cases.index(bar.doppler)
            level = rows.index(bar.look) + (case - (len(cases) - 1) / 2.0) * thick
            value, label = bar.rmse[place], condition(bar.doppler)
            hatch = "////" if bar.look == PUBLISHED else ""
            axes.barh(
                level, value, thick, color=colours[case], hatch=hatch, ec="white", label=label
            )
            ends = level - thick / 2.0, level + thick / 2.0
            axes.vlines(bar.bound[place], *ends, label="posterior bound, RMS", **MARK)
            if value < limit:
                end = max(value, bar.bound[place]) + 0.02 * limit
                axes.text(end, level, f"{value:.3f}", va="center", fontsize=8.5)
            else:
                axes.text(0.98 * limit, level, f"{value:.3f} →", ha="right", **OUTSIDE)
        axes.set_yticks(range(len(rows)), [look.label for look in rows])
        axes.set_ylim(len(rows) - 0.5, -0.5)
        axes.set_xlim(0.0, limit)
        axes.grid(visible=False, axis="y")
        axes.set_xlabel(f"RMSE of {quantity} [{QUANTITIES[quantity]}]")
    legend(figure, panels, len(cases) + 1)
    return figure


class Bar(NamedTuple):
    """RMSE and RMS bound of a filter in one case, in the units of QUANTITIES."""

    look: Look
    doppler: float | None
    rmse: Rmse
    bound: Rmse


def _bars(results: Results) -> list[Bar]:
    """The paper's behind those that stand beside it, then the other filters of the study."""
    paper = numbers.paper_beside(results)
    bars = []
    for doppler in numbers.cases(results):
        for name, look in looks(results.plan.filters).items():
            rmse = numbers.root_mean(numbers.squared_errors(results, name, doppler))
            bound = numbers.root_mean(numbers.squared_bounds(results, name, doppler))
            bars.append(Bar(look, doppler, rmse, bound))
        theirs = None if paper is None else paper.rmse_at(doppler)
        if theirs is not None:
            bars.append(Bar(PUBLISHED, doppler, theirs, bound))  # of the same runs for all
    beside = looks(of_kinds(results.plan.filters, COMPARED)).values()
    return sorted(bars, key=lambda bar: (bar.look not in beside, bar.look != PUBLISHED))


def _longest(bars: list[Bar], place: int) -> float:
    """The longest bar but for those of dead reckoning, which may run out of the panel."""
    lengths = [bar.rmse[place] for bar in bars if bar.look != LOOKS["dead_reckoning"]]
    return max(lengths or [bar.rmse[place] for bar in bars])
