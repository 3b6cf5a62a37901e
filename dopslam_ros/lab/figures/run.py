"""Pictures of runs."""

from __future__ import annotations

import math
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Ellipse

from dopslam_ros.core.linalg.arrays import FloatArray
from dopslam_ros.core.linalg.quantiles import chi_square
from dopslam_ros.core.settings.layout import CLOCK_BIAS, HEADING, VEHICLE, LandmarkType, X, Y
from dopslam_ros.lab.figures.style import BOUND, ESTIMATE, TRUTH
from dopslam_ros.messages.markers import ELLIPSOID_PROBABILITY, LOOKS
from dopslam_ros.offline.metrics import state_errors
from dopslam_ros.offline.replay_result import Replay

MARKS = {LandmarkType.BS: "^", LandmarkType.VA: "s", LandmarkType.SP: "o"}
# Ellipses are drawn this much larger: at true size they would vanish in a scene of 400 m.
MAGNIFIED = 10.0
NAMES = {
    LandmarkType.BS: "base station",
    LandmarkType.VA: "virtual anchor",
    LandmarkType.SP: "scattering point",
}


def draw_run(run: Replay, path: Path, title: str) -> None:
    """Track, map and errors of a run in one picture.

    Left: true and estimated track and landmarks from above, with 95 % ellipses (magnified). Right:
    error of position, heading and clock bias at each step beside the bound (one sigma) and the
    filter's own sigma.

    Raises:
        OSError: the file cannot be written.
    """
    figure = plt.figure(figsize=(13.0, 6.6), layout="constrained")
    grid = figure.add_gridspec(3, 2, width_ratios=[1.15, 1.0])
    _draw_map(figure.add_subplot(grid[:, 0]), run)
    steps = np.arange(1, len(run.outputs) + 1)
    errors = _errors(run)
    bounds = np.array([record.bound for record in run.records()]).reshape(-1, 3)
    sigmas = _sigmas(run)
    labels = ("position [m]", "heading [deg]", "clock bias [m]")
    scales = (1.0, math.degrees(1.0), 1.0)
    for row, (label, scale) in enumerate(zip(labels, scales, strict=True)):
        axes = figure.add_subplot(grid[row, 1])
        axes.plot(steps, errors[:, row] * scale, color=ESTIMATE, marker=".", label="error")
        axes.plot(steps, sigmas[:, row] * scale, color=ESTIMATE, ls=":", label="filter's sigma")
        axes.plot(steps, bounds[:, row] * scale, color=BOUND, lw=2, label="bound")
        axes.set_ylabel(label)
        axes.set_ylim(bottom=0.0)
        axes.grid(alpha=0.3)
        if row == 0:
            axes.legend(loc="upper right", ncols=3, fontsize="small")
    axes.set_xlabel("step")
    figure.suptitle(title)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _draw_map(axes: Axes, run: Replay) -> None:
    if run.true_map is not None:
        for kind in LandmarkType:
            place = run.true_map.of_type(kind)
            if len(place):
                axes.scatter(
                    place[:, 0],
                    place[:, 1],
                    marker=MARKS[kind],
                    s=90,
                    facecolors="none",
                    edgecolors=TRUTH,
                    linewidths=1.2,
                    label=f"{NAMES[kind]}, true",
                )
    truth = np.array([run.truth[s] for s in sorted(run.truth)]).reshape(-1, len(VEHICLE))
    track = np.array([output.state.ue_mean for output in run.outputs]).reshape(-1, len(VEHICLE))
    axes.plot(truth[:, 0], truth[:, 1], color=TRUTH, lw=3, alpha=0.4, label="track, true")
    axes.plot(track[:, 0], track[:, 1], color=ESTIMATE, lw=1.2, label="track, estimated")
    for output in run.outputs[:: max(1, len(run.outputs) // 12)]:
        covariance = output.state.ue_covariance[:2, :2]
        axes.add_patch(_ellipse(output.state.ue_mean[:2], covariance, ESTIMATE))
    if run.outputs:
        landmarks = run.outputs[-1].landmarks
        for kind in (LandmarkType.VA, LandmarkType.SP):
            mine = landmarks.types == kind
            axes.scatter(
                landmarks.positions[mine, 0],
                landmarks.positions[mine, 1],
                marker="x",
                s=45,
                color=LOOKS[kind].colour,
                label=f"{NAMES[kind]}, estimated",
            )
            for position, covariance in zip(
                landmarks.positions[mine], landmarks.covariances[mine], strict=True
            ):
                axes.add_patch(_ellipse(position[:2], covariance[:2, :2], LOOKS[kind].colour))
    axes.set_aspect("equal")
    axes.set_title(f"95 % ellipses, drawn {MAGNIFIED:g} times larger", fontsize="medium")
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")
    axes.grid(alpha=0.3)
    axes.legend(loc="upper left", bbox_to_anchor=(0.0, -0.08), ncols=2, fontsize="small")


def _ellipse(center: FloatArray, covariance: FloatArray, colour: object) -> Ellipse:
    """The region that holds the point with ELLIPSOID_PROBABILITY, from above, MAGNIFIED."""
    variances, axes = np.linalg.eigh(covariance)
    size = (
        MAGNIFIED * 2.0 * np.sqrt(np.maximum(variances, 0.0) * chi_square(ELLIPSOID_PROBABILITY, 2))
    )
    angle = math.degrees(math.atan2(axes[1, 1], axes[0, 1]))
    return Ellipse(
        tuple(center), size[1], size[0], angle=angle, facecolor="none", edgecolor=colour, lw=1.0
    )


def _errors(run: Replay) -> FloatArray:
    """(K, 3) magnitudes of the errors of position [m], heading [rad], clock bias [m]."""
    missing = np.full(len(VEHICLE), np.nan)
    errors = np.array(
        [state_errors(o.state.ue_mean, run.truth.get(o.stamp_ns, missing)) for o in run.outputs]
    ).reshape(-1, len(VEHICLE))
    return np.column_stack(
        [np.hypot(errors[:, X], errors[:, Y]), np.abs(errors[:, [HEADING, CLOCK_BIAS]])]
    )


def _sigmas(run: Replay) -> FloatArray:
    """(K, 3) the standard deviations the filter gives for them."""
    variance = np.array([np.diagonal(o.state.ue_covariance) for o in run.outputs]).reshape(
        -1, len(VEHICLE)
    )
    return np.sqrt(
        np.column_stack([variance[:, X] + variance[:, Y], variance[:, [HEADING, CLOCK_BIAS]]])
    )
