"""The numbers of a study against ones computed otherwise, and intervals that hold what they say."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import pytest
from scipy import stats

from dopslam_ros.core.linalg.arrays import FloatArray
from dopslam_ros.lab.study.plan import Plan
from dopslam_ros.lab.study.results import Case, Results
from dopslam_ros.lab.study.run import FIELDS
from dopslam_ros.lab.study.summary import nees_band, summarise_study
from dopslam_ros.simulation.scenario import Scenario

STEPS = 14
STDS = {"error_x": 0.3, "error_y": 0.2, "error_heading": 0.004, "error_clock": 0.1}


def table(rng: np.random.Generator, runs: int, scale: float = 1.0) -> FloatArray:
    """Errors that stay alike within a run, as those of a filter do."""
    part = np.zeros((runs, STEPS, len(FIELDS)))
    column = {name: part[:, :, number] for number, name in enumerate(FIELDS)}
    for name, std in STDS.items():
        steady, fresh = rng.standard_normal((runs, 1)), rng.standard_normal((runs, STEPS))
        column[name][:] = scale * std * (0.8 * steady + 0.6 * fresh)
    column["nees"][:] = rng.chisquare(4, (runs, STEPS))
    for name in ("gospa_va", "gospa_sp"):
        column[name][:] = rng.gamma(4.0, 1.0, (runs, STEPS)) + 20.0 * (np.arange(STEPS) < 4)
    for name, bound in (("peb", 0.35), ("heb", 0.004), ("ceb", 0.1)):
        column[name][:] = bound * rng.uniform(0.9, 1.1, (runs, STEPS))
    column["correct_weight"][:] = rng.beta(9, 1, (runs, STEPS))
    return part


def results(scenario: Scenario, tables: Mapping[Case, FloatArray]) -> Results:
    labels = tuple(dict.fromkeys(label for label, _ in tables))
    dopplers = tuple(dict.fromkeys(doppler for _, doppler in tables))
    runs = len(next(iter(tables.values())))
    return Results(Plan(scenario, labels, dopplers, runs, 1), tables)


def field(values: FloatArray, name: str) -> FloatArray:
    return values[:, :, FIELDS.index(name)]


def test_the_numbers(short: Scenario) -> None:
    values = table(np.random.default_rng(1), 30)
    summary = summarise_study(results(short, {("joint", None): values}))
    assert (summary["scenario"], summary["runs"], summary["steps"]) == ("paper", 30, 8)
    (row,) = summary["rows"]
    assert (row["filter"], row["doppler"]) == ("joint", None) and "to_first" not in row
    x, y, heading, clock = (field(values, name) for name in STDS)
    peb, heb, ceb = (field(values, name) for name in ("peb", "heb", "ceb"))

    def rms(*parts: FloatArray) -> float:
        return math.sqrt(np.mean(sum(part**2 for part in parts)))

    expected = {
        "position_rmse": rms(x, y),
        "heading_rmse_deg": math.degrees(rms(heading)),
        "clock_bias_rmse": rms(clock),
        "bound_position_rms": rms(peb),
        "bound_heading_rms_deg": math.degrees(rms(heb)),
        "bound_clock_rms": rms(ceb),
        "position_to_bound": rms(x, y) / rms(peb),
        "heading_to_bound": rms(heading) / rms(heb),
        "clock_to_bound": rms(clock) / rms(ceb),
        "nees_mean": field(values, "nees").mean(),
        "gospa_va": field(values, "gospa_va")[:, -10:].mean(),
        "gospa_sp": field(values, "gospa_sp")[:, -10:].mean(),
        "correct_association_weight": field(values, "correct_weight").mean(),
    }
    assert set(row) == {"filter", "doppler", *expected}
    for name, value in expected.items():
        assert row[name]["value"] == pytest.approx(value, rel=1e-12), name
        assert row[name]["low"] < value < row[name]["high"], name


def test_the_intervals_are_those_of_another_bootstrap(short: Scenario) -> None:
    """scipy's, of the runs; both draw at random, so they agree but for a few percent."""
    rng = np.random.default_rng(2)
    first, second = table(rng, 60), table(rng, 60, scale=1.3)
    tables = {("joint", 0.1): first, ("genie", 0.1): second}
    rows = summarise_study(results(short, tables))["rows"]

    def square(values: FloatArray) -> FloatArray:
        return (field(values, "error_x") ** 2 + field(values, "error_y") ** 2).mean(axis=1)

    def check(found: dict[str, float], data: tuple[FloatArray, ...], statistic: object) -> None:
        theirs = stats.bootstrap(
            data,
            statistic,
            paired=True,
            vectorized=True,
            n_resamples=9999,
            method="percentile",
            random_state=np.random.default_rng(3),
        ).confidence_interval
        width = theirs.high - theirs.low
        assert abs(found["low"] - theirs.low) < 0.08 * width
        assert abs(found["high"] - theirs.high) < 0.08 * width

    check(rows[0]["position_rmse"], (square(first),), lambda a, axis: np.sqrt(a.mean(axis)))
    nees = field(first, "nees").mean(axis=1)
    check(rows[0]["nees_mean"], (nees,), lambda a, axis: a.mean(axis))
    peb = (field(second, "peb") ** 2).mean(axis=1)
    check(
        rows[1]["position_to_bound"],
        (square(second), peb),
        lambda a, b, axis: np.sqrt(a.mean(axis) / b.mean(axis)),
    )
    check(
        rows[1]["to_first"]["position_rmse"],
        (square(second), square(first)),
        lambda a, b, axis: np.sqrt(a.mean(axis) / b.mean(axis)),
    )


def test_the_intervals_hold_what_they_say(short: Scenario) -> None:
    """95 % of them hold the truth; a bit less of 40 runs, as is known of the percentile method."""
    truth = math.hypot(0.3, 0.2)
    rng = np.random.default_rng(4)
    inside = 0
    for _ in range(150):
        summary = summarise_study(results(short, {("joint", 0.1): table(rng, 40)}))
        found = summary["rows"][0]["position_rmse"]
        inside += found["low"] < truth < found["high"]
    assert 0.87 < inside / 150 < 0.99


def test_pairs_are_compared_run_by_run(short: Scenario) -> None:
    """Errors twice as large on every run: the ratio is 2, for sure; of other runs it is not."""
    rng = np.random.default_rng(5)
    first, other = table(rng, 20), table(rng, 20, scale=2.0)
    double = first.copy()
    double[:, :, :4] *= 2.0
    tables = {("joint", 0.1): first, ("marginal", 0.1): double, ("genie", 0.1): other}
    rows = summarise_study(results(short, tables))["rows"]
    for name in ("position_rmse", "heading_rmse_deg", "clock_bias_rmse"):
        paired, loose = rows[1]["to_first"][name], rows[2]["to_first"][name]
        for end in ("value", "low", "high"):
            assert paired[end] == pytest.approx(2.0, rel=1e-12)
        assert loose["high"] - loose["low"] > 0.2
    assert rows[1]["to_first"]["gospa_va"]["value"] == 1.0


def test_each_doppler_has_its_first(short: Scenario) -> None:
    rng = np.random.default_rng(6)
    cases = [(label, doppler) for doppler in (0.1, None) for label in ("joint", "genie")]
    tables = {case: table(rng, 10, scale) for case, scale in zip(cases, (1, 2, 3, 3), strict=True)}
    rows = summarise_study(results(short, tables))["rows"]
    assert [(row["filter"], row["doppler"]) for row in rows] == cases
    assert ["to_first" in row for row in rows] == [False, True, False, True]
    ratios = [row["position_rmse"]["value"] for row in rows]
    for row, (ours, theirs) in ((rows[1], (1, 0)), (rows[3], (3, 2))):
        expected = ratios[ours] / ratios[theirs]
        assert row["to_first"]["position_rmse"]["value"] == pytest.approx(expected)


def test_the_band_of_an_honest_covariance() -> None:
    """Of the mean over runs at one step, drawn many times."""
    rng = np.random.default_rng(7)
    for runs in (5, 100):
        low, high = nees_band(runs)
        means = rng.chisquare(4, (4000, runs)).mean(axis=1)
        assert np.mean((low < means) & (means < high)) == pytest.approx(0.95, abs=0.012)
        assert low < 4.0 < high


def test_what_does_not_exist_is_nan(short: Scenario) -> None:
    """A filter without associations, a scene without SPs, a single run."""
    values = table(np.random.default_rng(8), 12)
    field(values, "correct_weight")[:] = np.nan
    field(values, "gospa_sp")[:] = 0.0
    tables = {("joint", 0.1): values, ("genie", 0.1): values}
    row = summarise_study(results(short, tables))["rows"][1]
    assert all(math.isnan(end) for end in row["correct_association_weight"].values())
    assert row["gospa_sp"] == {"value": 0.0, "low": 0.0, "high": 0.0}
    assert all(math.isnan(end) for end in row["to_first"]["gospa_sp"].values())
    (row,) = summarise_study(results(short, {("joint", 0.1): values[:1]}))["rows"]
    found = row["position_rmse"]
    assert found["value"] > 0.0 and math.isnan(found["low"]) and math.isnan(found["high"])


def test_the_same_study_has_the_same_bits(short: Scenario) -> None:
    values = table(np.random.default_rng(9), 25)
    one, other = (summarise_study(results(short, {("joint", 0.1): values})) for _ in range(2))
    assert repr(one) == repr(other)
