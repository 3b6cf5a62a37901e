"""Draws the figures of the concepts and of the architecture: python docs/draw.py docs/figures."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.patches import Arc, Ellipse, FancyBboxPatch

from dopslam_ros.core.models.channel import incidence_points
from dopslam_ros.core.settings.layout import LandmarkType
from dopslam_ros.lab.figures.style import BOUND, ESTIMATE, RC, TRUTH, plt

GREEN = "#009e73"
BS = np.array([-6.0, 0.0, 0.0])
UE = np.array([4.0, -2.0, np.radians(65.0), 0.0])
WALL_Y = 5.0
VA = np.array([-6.0, 2 * WALL_Y, 0.0])
SP = np.array([8.0, 3.0, 0.0])


def geometry(axes: Any) -> None:
    """One base station, one wall, one object: three paths, and what is measured of each."""
    types = np.array([LandmarkType.VA])
    hit = incidence_points(UE, VA[None], types, BS)[0]
    ue = UE[:2]
    axes.plot([-8, 10], [WALL_Y, WALL_Y], color=TRUTH, lw=5, solid_capstyle="butt")
    axes.text(9.9, WALL_Y + 0.25, "wall", ha="right", color=TRUTH)
    for points, colour, name, at in (
        ([BS[:2], ue], BOUND, "direct path", (-1.6, -1.75)),
        ([BS[:2], hit[:2], ue], ESTIMATE, "reflected", (-4.9, 2.6)),
        ([BS[:2], SP[:2], ue], GREEN, "scattered", (3.6, 2.65)),
    ):
        axes.plot(*np.transpose(points), color=colour)
        axes.text(*at, name, color=colour, ha="center")
    axes.plot(*np.transpose([VA[:2], hit[:2]]), color=ESTIMATE, ls=":")
    axes.plot(*np.transpose([BS[:2], VA[:2]]), color="0.6", ls=":")
    for place, marker, label, shift in (
        (BS, "^", "base station (BS)", (0.0, -0.9)),
        (VA, "s", "virtual anchor (VA):\nthe BS mirrored at the wall", (0.6, -0.25)),
        (SP, "o", "scattering point (SP)", (0.0, 0.45)),
        (hit, "x", "incidence point", (0.1, 0.35)),
    ):
        centred = "center" if shift[0] == 0.0 else "left"
        axes.plot(place[0], place[1], marker, color="black", ms=8)
        axes.text(place[0] + shift[0], place[1] + shift[1], label, ha=centred)
    _angles(axes, ue)
    axes.set(xlim=(-9.3, 12), ylim=(-4.6, 11.4), aspect="equal")
    axes.axis("off")


def _angles(axes: Any, ue: Any) -> None:
    heading = np.degrees(UE[2])
    ahead = np.array([np.cos(UE[2]), np.sin(UE[2])])
    axes.annotate("", ue + 3.6 * ahead, ue, arrowprops={"arrowstyle": "->", "lw": 2})
    axes.text(*(ue + 3.7 * ahead + [-0.3, 0.05]), "heading", ha="right")
    axes.plot(*ue, marker=(3, 0, heading - 90.0), color="black", ms=14)
    axes.text(ue[0] + 0.1, ue[1] - 1.0, "vehicle (UE)", ha="center")
    towards = np.degrees(np.arctan2(*(VA[:2] - ue)[::-1]))
    axes.add_patch(Arc(ue, 5.0, 5.0, theta1=heading, theta2=towards, color=ESTIMATE, lw=1.5))
    axes.text(1.75, 0.4, "azimuth of arrival", ha="right", color=ESTIMATE)
    leaving = np.degrees(np.arctan2(SP[1] - BS[1], SP[0] - BS[0]))
    axes.plot([BS[0], BS[0] + 4.4], [BS[1], BS[1]], color="0.6", ls=":")
    axes.text(BS[0] + 4.6, BS[1] - 0.15, "x of the map", color="0.45")
    axes.add_patch(Arc(BS[:2], 7.4, 7.4, theta1=0.0, theta2=leaving, color=GREEN, lw=1.5))
    axes.text(BS[0] - 0.4, BS[1] + 0.75, "azimuth of\ndeparture", ha="right", color=GREEN)


def density(axes: Any) -> None:
    """What a Poisson multi-Bernoulli density says of a map: tracks, and what was not seen yet."""
    axes.add_patch(FancyBboxPatch((0, 0), 10, 6, "round,pad=0.1", fc="#eef3f9", ec="0.7"))
    axes.text(0.3, 5.5, "Poisson: landmarks never detected, equally likely everywhere in here")
    axes.add_patch(Ellipse((2.7, 2.3), 4.6, 3.4, fc="white", ec="0.7", ls="--"))
    axes.text(2.7, 0.85, "looked here without\na detection: fewer left", ha="center", color="0.35")
    for (x, y), (w, h), tilt, existence, name in (
        ((7.0, 3.9), (2.3, 0.6), 25, 0.99, "r = 0.99, VA 0.98 / SP 0.02"),
        ((8.0, 1.7), (1.2, 0.7), -20, 0.90, "r = 0.90, VA 0.10 / SP 0.90"),
        ((2.8, 2.9), (1.4, 0.8), 60, 0.15, "r = 0.15: clutter, or new?"),
    ):
        face = (*plt.matplotlib.colors.to_rgb(ESTIMATE), 0.75 * existence)
        axes.add_patch(Ellipse((x, y), w, h, angle=tilt, fc=face, ec=ESTIMATE))
        axes.text(x, y - 0.95, name, ha="center")
    axes.set(xlim=(-0.2, 10.2), ylim=(-0.2, 6.2), aspect="equal")
    axes.axis("off")


ROBOT, LABORATORY = "#dce9f6", "#fdf0d9"
# The rooms of the package: what is in them, where they stand, and where they are used.
ROOMS = {
    "cli": ("the command dopslam", (6.0, 8.6), LABORATORY),
    "lab": ("studies, baselines, figures,\nreports, benchmarks", (6.0, 7.2), LABORATORY),
    "nodes": ("filter, bounds, recorder,\nplayer, simulator", (3.3, 5.7), ROBOT),
    "offline": ("replay of a bag,\nmetrics", (8.7, 5.7), ROBOT),
    "simulation": ("scenes, simulated runs,\nwarm-up", (6.0, 4.3), ROBOT),
    "system": ("files, storage,\nprocesses, Ctrl-C", (3.3, 2.9), ROBOT),
    "messages": ("topics, fields of messages", (8.7, 2.9), ROBOT),
    "bag": ("MCAP bags", (11.4, 1.1), ROBOT),
}
# The rooms of the core, each of which may know those to its left.
CORE = (
    "linalg",
    "settings",
    "models",
    "association",
    "pmb",
    "pcrb",
    "monitoring",
    "session",
)
# From a room to those that it knows; it also knows what they know.
ARROWS = {
    "cli": ("lab",),
    "lab": ("nodes", "offline"),
    "nodes": ("simulation",),
    "offline": ("simulation",),
    "simulation": ("system", "messages"),
    "system": ("core",),
    "messages": ("core", "bag"),
}


def architecture(axes: Any) -> None:
    """The rooms of the package, and which know which."""
    axes.set(xlim=(-0.6, 12.8), ylim=(-0.1, 9.3))
    axes.axis("off")
    frames = {"core": _core(axes)}
    for name, (text, (x, y), colour) in ROOMS.items():
        look = {"boxstyle": "round,pad=0.4", "fc": colour, "ec": "0.4"}
        label = f"$\\bf{{{name}}}$\n{text}"
        drawn = axes.text(x, y, label, ha="center", va="center", bbox=look, fontsize=9)
        frames[name] = drawn.get_bbox_patch()
    centres = {name: where for name, (_, where, _) in ROOMS.items()}
    for room, known in ARROWS.items():
        for other in known:
            start, end = centres[room], centres.get(other)
            # The core is wide: arrows go straight down to it.
            look = {"arrowstyle": "-|>", "color": "0.25", "patchA": frames[room], "shrinkA": 0}
            if end is None:
                end = (start[0], CORE_TOP)
            else:
                look["patchB"] = frames[other]
            axes.annotate("", end, start, arrowprops={**look, "shrinkB": 0})
    legend = "an arrow: knows the other, and all\nthat the other knows"
    axes.text(-0.4, 8.6, legend, color="0.35", va="center", fontsize=9)
    for text, colour, height in (("robot", ROBOT, 7.8), ("laboratory", LABORATORY, 7.3)):
        axes.plot(-0.25, height, "s", color=colour, mec="0.4", ms=9)
        axes.text(0.05, height, text, color="0.35", va="center", fontsize=9)


CORE_TOP = 1.9


def _core(axes: Any) -> Any:
    """The core with its rooms."""
    frame = FancyBboxPatch(
        (-0.4, 0.2), 10.4, CORE_TOP - 0.2, "round,pad=0.0", fc="#e3f1e6", ec="0.4"
    )
    axes.add_patch(frame)
    axes.text(
        4.8,
        1.6,
        "$\\bf{core}$: all mathematics, no ROS; each room may know those to its left",
        ha="center",
        va="center",
        fontsize=9,
    )
    left = 0.35
    for name in CORE:
        look = {"boxstyle": "round,pad=0.3", "fc": "white", "ec": "0.5"}
        axes.text(left, 0.75, name, ha="center", va="center", bbox=look, fontsize=8.5)
        left += 1.27
    return frame


FIGURES = {
    "geometry": (geometry, (9, 6.6)),
    "density": (density, (8, 5)),
    "architecture": (architecture, (9.5, 6.2)),
}


def main() -> None:
    """Writes every figure into the folder given."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    for name, (draw, size) in FIGURES.items():
        with plt.rc_context(RC):
            figure, axes = plt.subplots(figsize=size, layout="constrained")
            draw(axes)
            figure.savefig(folder / f"{name}.png")
            plt.close(figure)


if __name__ == "__main__":
    main()
