"""The paper's figures with a study of ours in them, and how far the study can be believed."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from matplotlib.style import context as style_context

from dopslam_ros.lab.figures import numbers
from dopslam_ros.lab.figures.numbers import QUANTITIES
from dopslam_ros.lab.figures.panels import band, curve, grid, legend, line, log_scale, pairs
from dopslam_ros.lab.figures.rmse import rmse_bars
from dopslam_ros.lab.figures.style import (
    COMPARED,
    LOOKS,
    PUBLISHED,
    RC,
    condition,
    doppler_colours,
    looks,
    of_kinds,
    save,
)
from dopslam_ros.lab.published import Kind, published
from dopslam_ros.lab.study.results import Results

BOUNDS = ("position: PEB [m]", "heading: HEB [deg]", "clock bias: CEB [m]", "map: mean LEB [m]")


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
        if not of_kinds(results.plan.filters, (name,)):
            texts.append(f"filter {name}")
    for figure, plot in FIGURES.items():
        known = _known(results, plot)
        if plot.field and not known:
            texts.append(f"figure {figure}, which shows {', '.join(plot.kinds)}")
            continue
        unknown = [name for name in of_kinds(results.plan.filters, plot.kinds) if name not in known]
        if unknown:
            texts.append(f"{', '.join(unknown)} in figure {figure}")
    return texts


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
        for name, look in looks(of_kinds(results.plan.filters, COMPARED)).items():
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
    "rmse": Plot(rmse_bars, "error_x", tuple(LOOKS)),
    "association": Plot(_association, "correct_weight", tuple(LOOKS)),
    "nees": Plot(_nees, "nees", tuple(LOOKS)),
    "error_over_bound": Plot(_error_over_bound, "error_x", tuple(LOOKS)),
}


def _known(results: Results, plot: Plot) -> list[str]:
    """The filters of the study that have what a figure shows."""
    case = results.plan.dopplers[0]
    return [
        label
        for label in of_kinds(results.plan.filters, plot.kinds)
        if numbers.curve(results, label, case, plot.field) is not None
    ]
