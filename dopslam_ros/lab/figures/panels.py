"""Rows of panels under one legend, and lines over time in them."""

from __future__ import annotations

import math
from typing import Any, Literal, TypeAlias

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator

from dopslam_ros.core.linalg.arrays import FloatArray
from dopslam_ros.lab.figures.numbers import Band, Curve
from dopslam_ros.lab.figures.style import Look

Share: TypeAlias = Literal["all", "row", "none"]

WIDTH = 9.0  # of a figure [inches]
LEAST_PANEL_WIDTH = 3.0
ROW_OF_KEY = 0.22


def grid(rows: int, columns: int, height: float, share: Share) -> tuple[Figure, Any]:
    """A figure with (rows, columns) panels.

    Args:
        rows: of panels.
        columns: of panels.
        height: of the figure [inches].
        share: which panels have one y axis.
    """
    width = max(WIDTH, columns * LEAST_PANEL_WIDTH)
    figure = plt.figure(figsize=(width, height), layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False, sharey=share)


def pairs(count: int, height: float, label: str) -> tuple[Figure, Any]:
    """A figure with (count,) panels, two in a row, with one y axis for all.

    Args:
        count: of panels.
        height: of a row [inches].
        label: of the y axis.
    """
    rows, columns = math.ceil(count / 2), min(count, 2)
    figure, panels = grid(rows, columns, rows * height, "all")
    for axes in panels.flat[count:]:
        axes.remove()
    for axes in panels[:, 0]:
        axes.set_ylabel(label)
    return figure, panels.flat[:count]


def legend(figure: Figure, panels: Any, columns: int) -> None:
    """One legend for all panels, above them, each name once."""
    found: dict[str, Any] = {}
    for axes in panels.flat:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            found.setdefault(label, handle)
    columns = min(columns, len(found))
    share = (0.1 + math.ceil(len(found) / columns) * ROW_OF_KEY) / figure.get_figheight()
    figure.set_layout_engine("constrained", rect=(0.0, 0.0, 1.0, 1.0 - share))
    figure.legend(found.values(), found.keys(), loc="upper center", ncols=columns, frameon=False)


def line(axes: Axes, values: FloatArray, look: Look) -> None:
    """Values (K,) over the steps 1 ... K."""
    steps = np.arange(1, len(values) + 1)
    axes.plot(
        steps,
        values,
        color=look.colour,
        ls=look.line,
        marker=look.marker,
        ms=3.5,
        markevery=3,
        zorder=look.layer,
        label=look.label,
    )
    axes.set_xlim(0, len(values) + 1)
    axes.set_xlabel("time step")


def curve(axes: Axes, values: Curve, look: Look) -> None:
    """A mean with its standard error as a band."""
    steps = np.arange(1, len(values.mean) + 1)
    ends = values.mean - values.error, values.mean + values.error
    axes.fill_between(steps, *ends, color=look.colour, alpha=0.25, lw=0)
    line(axes, values.mean, look)


def log_scale(axes: Axes) -> None:
    """A logarithmic y axis with plain numbers."""
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 1.5, 2.0, 3.0, 5.0)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_locator(LogLocator(subs=()))


def band(axes: Axes, ends: Band, middle: float, label: str) -> None:
    """Where a line should be: about ``middle``, nearly always between the ends."""
    axes.axhspan(*ends, color="0.85", lw=0, label=label)
    axes.axhline(middle, color="0.5", lw=0.8, zorder=1.0)
