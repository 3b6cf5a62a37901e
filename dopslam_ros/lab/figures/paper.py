"""The paper's figures with a study of ours in them, and how far the study can be believed."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.style import context as style_context

from dopslam_ros.lab.figures import numbers
from dopslam_ros.lab.figures.panels import band, curve, grid, legend, line, log_scale, pairs
from dopslam_ros.lab.figures.style import (
    LOOKS,
    PUBLISHED,
    RC,
    Look,
    doppler_colours,
    kind,
    looks,
    save,
)
from dopslam_ros.lab.published import Kind, published
from dopslam_ros.lab.study.results import Results
from dopslam_ros.offline.metrics import Rmse

# The filters that stand beside the paper's: the default, and the paper's form.
COMPARED = ("joint", "marginal")
QUANTITIES = {"position": "m", "heading": "deg", "clock bias": "m"}
BOUNDS = ("position: PEB [m]", "heading: HEB [deg]", "clock bias: CEB [m]", "map: mean LEB [m]")
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


def draw_study(results: Results, folder: Path) -> list[str]:
    """Writes each figure as NAME.png and NAME.svg, with what the study has for it.

    Returns:
        The names. A figure that the study has nothing for is left out; see ``missing``.

    Raises:
        OSError: a file cannot be written.
    """
    names = [name for name, plot in FIGURES.items() if not plot.field or _known(results, plot)]
    with style_context(["default", RC]):  # whatever the user has set
        for name in names:
            save(FIGURES[name].draw(results), folder, name)
    return names


def missing(results: Results) -> list[str]:
    """What the figures could show and the study does not have."""
    plan, done = results.plan, len(results.run_numbers)
    texts = []
    if done < plan.runs:
        texts.append(f"{plan.runs - done} of the {plan.runs} runs")
    if numbers.paper_beside(results) is None:
        name = plan.scenario.name
        texts.append(f"published numbers, but for the bounds: scene '{name}' is not the paper's")
    for doppler in (published().filter_sigma, None):
        if doppler not in plan.dopplers:
            texts.append(f"the paper's case {condition(doppler)}")
    for name in LOOKS:
        if not _filters(results, (name,)):
            texts.append(f"filter {name}")
    for figure, plot in FIGURES.items():
        known = _known(results, plot)
        if plot.field and not known:
            texts.append(f"figure {figure}, which shows {', '.join(plot.kinds)}")
            continue
        unknown = [name for name in _filters(results, plot.kinds) if name not in known]
        if unknown:
            texts.append(f"{', '.join(unknown)} in figure {figure}")
    return texts


def condition(doppler: float | None) -> str:
    """A Doppler noise [m/s] in words."""
    return "without Doppler" if doppler is None else f"with Doppler, {doppler:g} m/s"


# --- figures -------------------------------------------------------------------------------------


def _bounds(_: Results) -> Figure:
    """Bounds at the last step over the Doppler noise: our lines through their points."""
    paper = published()
    sigmas = np.geomspace(paper.sigmas[0], paper.sigmas[-1], 20)
    ours = np.array([numbers.bounds_at(sigma) for sigma in sigmas.tolist()])
    theirs = np.array([paper.bounds_at(sigma) for sigma in paper.sigmas])
    limit, their_limit = np.array([numbers.bounds_at(None), paper.bounds_at(None)])
    dark, light = doppler_colours(2)
    points: dict[str, Any] = {"color": "black", "mfc": "none", "ls": "", "ms": 6}
    figure, panels = grid(2, 2, 5.6, "none")
    for place, axes in enumerate(panels.flat):
        axes.plot(sigmas, ours[:, place], color=dark, label="with Doppler, ours")
        label = "with Doppler, published"
        axes.plot(paper.sigmas, theirs[:, place], marker="o", label=label, **points)
        axes.axhline(limit[place], ls="--", color=light, label="without, ours")
        level = np.full(len(paper.sigmas), their_limit[place])
        axes.plot(paper.sigmas, level, marker="x", label="without, published", **points)
        axes.set_title(BOUNDS[place])
        axes.set_ylim(0.0, 1.15 * their_limit[place])
    for axes in panels[-1]:
        axes.set_xlabel("standard deviation of the Doppler [m/s]")
    legend(figure, panels, 4)
    return figure


def _gospa(results: Results, landmarks: Kind) -> Figure:
    """GOSPA over time: the mean over runs with its standard error, and the published curve."""
    paper = numbers.paper_beside(results)
    figure, panels = pairs(len(results.plan.dopplers), 3.7, "GOSPA distance [m]")
    for axes, doppler in zip(panels, numbers.cases(results), strict=True):
        theirs = None if paper is None else paper.gospa_at(landmarks, doppler)
        if theirs is not None:
            line(axes, theirs, PUBLISHED)
        for name, look in looks(_filters(results, COMPARED)).items():
            ours = numbers.curve(results, name, doppler, f"gospa_{landmarks}")
            if ours is not None:
                curve(axes, ours, look)
        axes.set_title(condition(doppler))
        axes.set_ylim(bottom=0.0)
    legend(figure, panels, 4)
    return figure


def _association(results: Results) -> Figure:
    """The weight of the correct association over time, its mean over time beside the name."""
    paper = numbers.paper_beside(results)
    figure, panels = pairs(len(results.plan.dopplers), 3.7, "weight of the correct association")
    for axes, doppler in zip(panels, numbers.cases(results), strict=True):
        theirs = None if paper is None else paper.correct_weight_at(doppler)
        for name, look in looks(results.plan.filters).items():
            ours = numbers.curve(results, name, doppler, "correct_weight")
            if ours is not None:
                mean = float(ours.mean.mean())
                ratio = "" if theirs is None else f" = {mean / theirs:.2f} × published"
                curve(axes, ours, look._replace(label=f"{look.label}: {mean:.3f}{ratio}"))
        if theirs is not None:
            label = f"{PUBLISHED.label} (mean): {theirs:.3f}"
            axes.axhline(theirs, color=PUBLISHED.colour, ls=PUBLISHED.line, label=label)
        axes.set_title(condition(doppler))
        axes.set_ylim(0.0, 1.03)
        axes.legend(loc="lower right")
    return figure


def _rmse(results: Results) -> Figure:
    """Bars of the RMSE over all steps and runs, each with a mark at the bound."""
    bars, cases = _bars(results), numbers.cases(results)
    rows = list(dict.fromkeys(bar.look for bar in bars))
    thick, colours = 0.8 / len(cases), doppler_colours(len(cases))
    figure, panels = grid(1, len(QUANTITIES), 1.2 + 0.22 * len(rows) * len(cases), "all")
    for place, (axes, quantity) in enumerate(zip(panels[0], QUANTITIES, strict=True)):
        reach = 1.35 * _longest(bars, place)
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
            if value < reach:
                end = max(value, bar.bound[place]) + 0.02 * reach
                axes.text(end, level, f"{value:.3f}", va="center", fontsize=8.5)
            else:
                axes.text(0.98 * reach, level, f"{value:.3f} →", ha="right", **OUTSIDE)
        axes.set_yticks(range(len(rows)), [look.label for look in rows])
        axes.set_ylim(len(rows) - 0.5, -0.5)
        axes.set_xlim(0.0, reach)
        axes.grid(visible=False, axis="y")
        axes.set_xlabel(f"RMSE of {quantity} [{QUANTITIES[quantity]}]")
    legend(figure, panels, len(cases) + 1)
    return figure


def _nees(results: Results) -> Figure:
    """NEES over time, the mean over runs, and where it lies when the covariance is true."""
    runs = len(results.run_numbers)
    figure, panels = pairs(len(results.plan.dopplers), 3.9, f"NEES, mean over {runs} runs")
    ends = numbers.mean_square_band(runs, numbers.STATE_SIZE)
    for axes, doppler in zip(panels, numbers.cases(results), strict=True):
        band(axes, ends, numbers.STATE_SIZE, "95 % band of a true covariance")
        log_scale(axes)
        for name, look in looks(results.plan.filters).items():
            ours = numbers.curve(results, name, doppler, "nees")
            if ours is not None:
                line(axes, ours.mean, look)
        axes.set_title(condition(doppler))
    legend(figure, panels, 4)
    return figure


def _error_over_bound(results: Results) -> Figure:
    """RMSE over runs divided by the RMS bound, at each step.

    The band is of a Gaussian error in one dimension whose variance is the bound; that of the
    position, which has two dimensions, is narrower.
    """
    figure, panels = grid(3, len(results.plan.dopplers), 7.4, "row")
    low, high = numbers.mean_square_band(len(results.run_numbers), 1)
    ends = numbers.Band(math.sqrt(low), math.sqrt(high))
    for column, doppler in zip(panels.T, numbers.cases(results), strict=True):
        for axes in column:
            band(axes, ends, 1.0, "95 % band at the bound")
            log_scale(axes)
        for name, look in looks(results.plan.filters).items():
            ratio = numbers.over_bound(results, name, doppler)
            for axes, values in zip(column, ratio.T, strict=True):
                line(axes, values, look)
        for axes in column[:-1]:
            axes.set_xlabel("")
        column[0].set_title(condition(doppler))
    for axes, quantity in zip(panels[:, 0], QUANTITIES, strict=True):
        axes.set_ylabel(f"{quantity}\nRMSE / bound")
    legend(figure, panels, 4)
    return figure


class Plot(NamedTuple):
    """A figure: what draws it, and the field of which filters it needs, "" for none."""

    draw: Callable[[Results], Figure]
    field: str
    kinds: tuple[str, ...]


FIGURES = {
    "bounds": Plot(_bounds, "", ()),
    "gospa_va": Plot(partial(_gospa, landmarks="va"), "gospa_va", COMPARED),
    "gospa_sp": Plot(partial(_gospa, landmarks="sp"), "gospa_sp", COMPARED),
    "rmse": Plot(_rmse, "error_x", tuple(LOOKS)),
    "association": Plot(_association, "correct_weight", tuple(LOOKS)),
    "nees": Plot(_nees, "nees", tuple(LOOKS)),
    "error_over_bound": Plot(_error_over_bound, "error_x", tuple(LOOKS)),
}


# --- pieces --------------------------------------------------------------------------------------


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
    beside = looks(_filters(results, COMPARED)).values()
    return sorted(bars, key=lambda bar: (bar.look not in beside, bar.look != PUBLISHED))


def _longest(bars: list[Bar], place: int) -> float:
    """The longest bar but for those of dead reckoning, which may run out of the panel."""
    lengths = [bar.rmse[place] for bar in bars if bar.look != LOOKS["dead_reckoning"]]
    return max(lengths or [bar.rmse[place] for bar in bars])


def _filters(results: Results, kinds: tuple[str, ...]) -> list[str]:
    """The labels of a study that name one of some filters."""
    return [label for label in results.plan.filters if kind(label) in kinds]


def _known(results: Results, plot: Plot) -> list[str]:
    """The filters of the study that have what a figure shows."""
    case = results.plan.dopplers[0]
    return [
        label
        for label in _filters(results, plot.kinds)
        if numbers.curve(results, label, case, plot.field) is not None
    ]
