"""The picture of a run: there, not blank, and with what it should show."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib.image
import matplotlib.pyplot as plt
import numpy as np
import pytest
from scipy.stats import chi2

from dopslam_ros.bag import BagReader, BagWriter
from dopslam_ros.cli.main import main
from dopslam_ros.lab.figures.run import MAGNIFIED, _ellipse, draw_run
from dopslam_ros.offline.replay import replay
from dopslam_ros.offline.replay_result import Replay

if TYPE_CHECKING:
    from tests.conftest import LiveRun

STEPS = 8


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[Any]]:
    """The figures that are made, kept open to be looked at."""
    figures: list[Any] = []
    monkeypatch.setattr(plt, "close", figures.append)
    yield figures
    monkeypatch.undo()
    for figure in figures:
        plt.close(figure)


def picture(path: Path) -> np.ndarray:
    """A PNG as (rows, columns, channels)."""
    return np.asarray(matplotlib.image.imread(path))


def test_the_picture_is_not_blank(live: LiveRun, tmp_path: Path) -> None:
    """The file is a picture of a good size with many colours, in its left and its right half."""
    draw_run(replay(BagReader(live.bag)), tmp_path / "run.png", "a run")
    image = picture(tmp_path / "run.png")
    assert image.shape[0] > 600 and image.shape[1] > 1200
    for half in np.array_split(image[..., :3], 2, axis=1):
        assert (half < 0.95).any(axis=2).mean() > 0.01
        assert len(np.unique(half.reshape(-1, 3), axis=0)) > 50
    assert not plt.get_fignums(), "figures are closed"


def test_track_map_and_errors_are_in_it(live: LiveRun, tmp_path: Path, drawn: list[Any]) -> None:
    """Left the tracks, right the errors beside the bound, with the numbers of the run."""
    run = replay(BagReader(live.bag))
    draw_run(run, tmp_path / "run.png", "the title")
    (figure,) = drawn
    assert figure._suptitle.get_text() == "the title"
    left, *right = figure.axes
    lines = {line.get_label(): line for line in left.get_lines()}
    estimate = np.array([o.state.ue_mean[:2] for o in run.outputs])
    assert np.array_equal(lines["track, estimated"].get_xydata(), estimate)
    truth = np.array([run.truth[o.stamp_ns][:2] for o in run.outputs])
    assert np.array_equal(lines["track, true"].get_xydata(), truth)
    assert len(left.patches) > STEPS, "ellipses of the vehicle and of landmarks"
    assert len(right) == 3
    curves = {line.get_label(): line.get_ydata() for line in right[0].get_lines()}
    assert np.allclose(curves["error"], np.linalg.norm(estimate - truth, axis=1))
    bounds = [run.bounds[o.stamp_ns].with_doppler.peb for o in run.outputs]
    assert np.allclose(curves["bound"], bounds)
    assert [axes.get_ylabel() for axes in right] == [
        "position [m]",
        "heading [deg]",
        "clock bias [m]",
    ]


def test_a_run_without_truth_is_drawn(live: LiveRun, tmp_path: Path) -> None:
    """A recording from a car has no truth: the estimate alone is drawn."""
    names = {"/channel_measurements", "/odometry_control"}
    with BagWriter(tmp_path / "bag") as writer:
        for message in BagReader(live.bag).messages(names):
            writer.add_topic(message.topic, message.type_name)
            writer.write(message.topic, message.payload, message.log_time_ns)
    run = replay(BagReader(tmp_path / "bag"))
    draw_run(run, tmp_path / "run.png", "no truth")
    assert (picture(tmp_path / "run.png")[..., :3] < 0.95).any()


def test_an_empty_run_is_drawn(tmp_path: Path) -> None:
    """Nothing to show is no reason to fail."""
    from dopslam_ros.core.pmb import FilterParameters

    draw_run(Replay(FilterParameters()), tmp_path / "run.png", "nothing")
    assert picture(tmp_path / "run.png").shape[2] in (3, 4)


def test_the_command_draws(live: LiveRun, tmp_path: Path) -> None:
    """`dopslam replay --picture` writes the file."""
    assert main(["replay", str(live.bag), "--picture", str(tmp_path / "run.png")]) == 0
    assert (picture(tmp_path / "run.png")[..., :3] < 0.95).any()


@pytest.mark.parametrize("angle", [0.0, 0.7, 2.0])
def test_ellipses_are_those_of_the_covariance(angle: float) -> None:
    """On the outline, less its magnification, x' P^-1 x is the 95 % quantile of chi2 with 2."""
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    covariance = turn @ np.diag([9.0, 1.0]) @ turn.T
    center = np.array([3.0, -2.0])
    ellipse = _ellipse(center, covariance, "red")
    outline = ellipse.get_patch_transform().transform(ellipse.get_path().vertices)
    # Vertices of the Bezier curve that lie on it, its control points left out.
    on_it = (outline[:-1:3] - center) / MAGNIFIED
    distance = np.einsum("ni,ij,nj->n", on_it, np.linalg.inv(covariance), on_it)
    assert np.allclose(distance, chi2.ppf(0.95, 2), rtol=1e-3)
