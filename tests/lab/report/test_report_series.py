"""The numbers behind the charts of a run: against those in the bag, and against SciPy."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import plotly.graph_objects as go
import pytest
from scipy.stats import chi2

from dopslam_ros.bag import BagReader, deserialize
from dopslam_ros.core.settings.layout import LandmarkType
from dopslam_ros.lab.report.charts import sections
from dopslam_ros.lab.report.page import PALETTE
from dopslam_ros.lab.report.scene import Source, extent_of, scene_of
from dopslam_ros.lab.report.series import Series, series_of
from dopslam_ros.messages import topics
from dopslam_ros.offline.replay import replay
from dopslam_ros.offline.replay_result import Replay
from dopslam_ros.simulation.scenario import load_scenario
from dopslam_ros.simulation.simulator import all_landmarks, simulate

if TYPE_CHECKING:
    from tests.conftest import LiveRun

STEPS = 8
ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture(scope="module")
def run(live: LiveRun) -> Replay:
    """The live run, filtered anew."""
    return replay(BagReader(live.bag))


@pytest.fixture(scope="module")
def series(run: Replay) -> Series:
    """Its numbers over time."""
    return series_of(run)


def heard(live: LiveRun, topic: topics.Topic) -> list[Any]:
    return [deserialize(p, topic.type_name) for p in live.heard[topic.name]]


def test_errors_and_sigmas_are_those_of_what_was_published(live: LiveRun, series: Series) -> None:
    """Against the messages of the filter and the simulator."""
    said, true = heard(live, topics.UE_STATE), heard(live, topics.TRUTH_UE)
    pairs = list(zip(said, true, strict=True))
    expected = [np.hypot(a.x - b.x, a.y - b.y) for a, b in pairs]
    np.testing.assert_allclose(series["error_position"], expected, rtol=1e-9)
    turned = [np.degrees(abs(np.angle(np.exp(1j * (a.heading - b.heading))))) for a, b in pairs]
    np.testing.assert_allclose(series["error_heading"], turned, rtol=1e-6)
    np.testing.assert_allclose(
        series["error_clock"], [abs(a.clock_bias - b.clock_bias) for a, b in pairs], rtol=1e-9
    )
    variances = np.array([np.diag(np.reshape(a.covariance, (4, 4))) for a in said])
    np.testing.assert_allclose(
        series["sigma_position"], np.sqrt(variances[:, 0] + variances[:, 1]), rtol=1e-9
    )
    np.testing.assert_allclose(
        series["sigma_heading"], np.degrees(np.sqrt(variances[:, 2])), rtol=1e-9
    )
    stamps = [a.header.stamp.sec + a.header.stamp.nanosec * 1e-9 for a in said]
    np.testing.assert_allclose(series["time"], np.array(stamps) - stamps[0], atol=1e-9)


def test_bounds_are_those_that_were_published(live: LiveRun, series: Series) -> None:
    """With Doppler and without, against the messages of the bounds."""
    said = heard(live, topics.BOUNDS)
    for column, field, scale in (
        ("bound_position", "peb", 1.0),
        ("bound_heading", "heb", np.degrees(1.0)),
        ("bound_clock", "ceb", 1.0),
    ):
        ours = [getattr(message, field) * scale for message in said]
        np.testing.assert_allclose(series[column], ours, rtol=1e-9)
        plain = [getattr(message, f"{field}_without_doppler") * scale for message in said]
        np.testing.assert_allclose(series[f"plain_{column}"], plain, rtol=1e-9)


def test_the_parts_of_gospa_add_up(run: Replay, series: Series) -> None:
    """Squared they are the distance; what is missed and false are whole landmarks of 200 m^2."""
    assert run.true_map is not None
    for kind in (LandmarkType.VA, LandmarkType.SP):
        name = kind.name.lower()
        parts = {
            part: series[f"{name}_{part}"] ** 2
            for part in ("distance", "localisation", "missed", "false")
        }
        together = parts["localisation"] + parts["missed"] + parts["false"]
        np.testing.assert_allclose(parts["distance"], together, atol=1e-9)
        found = np.array([np.count_nonzero(o.landmarks.types == kind) for o in run.outputs])
        balance = (parts["missed"] - parts["false"]) / 200.0
        np.testing.assert_allclose(balance, len(run.true_map.of_type(kind)) - found, atol=1e-9)


def test_bands_hold_nineteen_of_twenty(run: Replay, series: Series) -> None:
    """A chi-square of the right degrees of freedom lies in the bands with 95 %."""
    inside = chi2.cdf(series["nees_high"], 4) - chi2.cdf(series["nees_low"], 4)
    np.testing.assert_allclose(inside, 0.95)
    freedom = np.array([output.associations.nis_dof for output in run.outputs], dtype=float)
    told = freedom > 0
    ends = [series[name][told] * freedom[told] for name in ("nis_low", "nis_high")]
    low, high = (chi2.cdf(end, freedom[told]) for end in ends)
    np.testing.assert_allclose(high - low, 0.95)
    assert told.sum() > STEPS // 2 and np.isnan(series["nis"][~told]).all()


def test_weights_share_one(series: Series) -> None:
    """Of the best, the second and the rest."""
    shares = [series[f"weight_{name}"] for name in ("best", "second", "rest")]
    np.testing.assert_allclose(np.sum(shares, axis=0), 1.0)
    assert all((share >= 0.0).all() for share in shares)


def test_paths_are_taken_for_what_they_are() -> None:
    """In the reference run nearly every path goes where the simulator sent it from.

    Paths over a wall bend on the true wall, those over an object at the true object.
    """
    run = replay(BagReader(ROOT / "bags" / "paper"))
    scene = scene_of(run)
    scenario = load_scenario("paper")
    positions, types = all_landmarks(scenario)
    right, bends = [], []
    for k, snapshot in enumerate(simulate(scenario, np.random.default_rng(scenario.seed))):
        begin, end = scene["path_start"][k : k + 2].astype(int)
        assert end - begin == len(snapshot.sources)
        for row, true in zip(range(begin, end), snapshot.sources, strict=True):
            source = Source(int(scene["path_source"][row]))
            if true < 0:
                right.append(source == Source.CLUTTER)
                continue
            kind = LandmarkType(int(types[true]))
            same = {
                LandmarkType.BS: source == Source.LOS,
                LandmarkType.VA: source in (Source.VA, Source.NEW),
                LandmarkType.SP: source in (Source.SP, Source.NEW),
            }[kind]
            right.append(same)
            if same and k > 10:
                point = np.array([scene["path_x"][row], scene["path_y"][row]])
                bends.append(_distance(point, kind, positions[true, :2], scenario.bs[:2]))
    assert np.mean(right) > 0.97
    assert np.max(bends) < 5.0 and len(bends) > 80


def _distance(point: Any, kind: LandmarkType, place: Any, bs: Any) -> float:
    """Of a point from a wall, which lies half-way to its virtual anchor, or from a place [m]."""
    if kind != LandmarkType.VA:
        return float(np.linalg.norm(point - place))
    normal = (place - bs) / np.linalg.norm(place - bs)
    return float(abs((point - 0.5 * (place + bs)) @ normal))


def test_everything_worth_seeing_is_inside(run: Replay) -> None:
    """The extent of the map holds tracks, reported and true landmarks and the base station."""
    scene = scene_of(run)
    x0, x1, y0, y1 = extent_of(run, scene)
    assert run.true_map is not None
    points = [run.true_map.positions[:, :2], run.parameters.bs[None, :2]]
    points += [o.landmarks.positions[:, :2] for o in run.outputs]
    points += [np.array([o.state.ue_mean[:2] for o in run.outputs])]
    everything = np.vstack(points)
    assert (everything > [x0, y0]).all() and (everything < [x1, y1]).all()


def _put_in(value: Any, columns: Series) -> Any:
    if isinstance(value, str) and value.startswith("@"):
        return columns[value[1:]]
    if isinstance(value, str) and value.startswith("$"):
        return PALETTE[value[1:].removesuffix("~")][0]
    if isinstance(value, list):
        return [_put_in(item, columns) for item in value]
    if isinstance(value, dict):
        return {key: _put_in(item, columns) for key, item in value.items()}
    return value


def test_charts_are_what_the_library_takes(series: Series) -> None:
    """Plotly's own check knows every attribute, and every column and colour exists."""
    counts = {f"count_{source.name.lower()}": series["time"] for source in Source}
    for section in sections(True, True):
        for chart in section.charts:
            figure = go.Figure(
                _put_in(chart.traces, series | counts), _put_in(chart.layout, series | counts)
            )
            assert len(figure.data) == len(chart.traces) > 0
