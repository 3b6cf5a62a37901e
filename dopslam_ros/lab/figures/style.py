"""What all pictures share: colours, fonts, and files that are the same bytes each time."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib

matplotlib.use("Agg")  # files only, no screen needed

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

TRUTH = "0.35"
ESTIMATE = "#c03030"
BOUND = "#2060a0"

# For a width of 9 inches shown at some 900 pixels.
RC: dict[Any, Any] = {
    "font.size": 10.0,
    "axes.titlesize": 10.5,
    "axes.labelsize": 10.0,
    "legend.fontsize": 9.5,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "grid.alpha": 0.3,
    "lines.linewidth": 1.8,
    "savefig.dpi": 150,
    "savefig.facecolor": "white",
    "svg.hashsalt": "dopslam",
}


class Look(NamedTuple):
    """How a filter is named and drawn; line styles differ too, for eyes that see no colour.

    A line of a lower layer is drawn first.
    """

    label: str
    colour: str
    line: str
    marker: str = ""
    layer: float = 2.0


# In the order of the legends. The colours that are not of all pictures are Okabe and Ito's.
LOOKS = {
    "joint": Look("joint (ours)", ESTIMATE, "-"),
    "marginal": Look("marginal (paper's form)", "#e69f00", "--"),
    "pmbm": Look("PMBM", "#cc79a7", "-."),
    "phd": Look("EK-PHD", "#56b4e9", ":"),
    "genie": Look("association known", "#009e73", "-", "s", 1.8),
    "dead_reckoning": Look("dead reckoning", "0.6", "-", "x", 1.8),
}
# The filters that stand beside the paper's: the default, and the paper's form.
COMPARED = ("joint", "marginal")
# For filters with settings of their own, as joint:gamma=20.
VARIANTS = (("#0072b2", "^"), ("#8c564b", "v"), ("#7f3c8d", "D"), ("0.25", "P"))
PUBLISHED = Look("Ge et al., published", "black", ":", "o")


def kind(label: str) -> str:
    """The filter that a label of a study names, without the settings behind a colon."""
    return label.partition(":")[0]


def of_kinds(labels: Iterable[str], kinds: tuple[str, ...]) -> list[str]:
    """Those of the labels of a study that name one of some filters."""
    return [label for label in labels if kind(label) in kinds]


def condition(doppler: float | None) -> str:
    """A Doppler noise [m/s] in words."""
    return "without Doppler" if doppler is None else f"with Doppler, {doppler:g} m/s"


def looks(labels: Iterable[str]) -> dict[str, Look]:
    """How the filters of a study look, by their labels, in the order of LOOKS."""
    order = list(LOOKS)
    variants = itertools.cycle(VARIANTS)
    found = {}
    for label in sorted(labels, key=lambda label: (order.index(kind(label)), label)):
        if label in LOOKS:
            found[label] = LOOKS[label]
        else:
            colour, marker = next(variants)
            found[label] = Look(label, colour, "-", marker, 1.9)
    return found


def doppler_colours(count: int) -> list[Any]:
    """A colour for each case, dark for the least noise, light for without Doppler."""
    return list(matplotlib.colormaps["cividis"](np.linspace(0.1, 0.8, count)))


def save(figure: Figure, folder: Path, name: str) -> None:
    """Writes ``name``.png and ``name``.svg, which hold no date, and closes the figure.

    Raises:
        OSError: they cannot be written.
    """
    try:
        for suffix in ("png", "svg"):
            figure.savefig(folder / f"{name}.{suffix}", metadata={"Date": None})
    finally:
        plt.close(figure)
