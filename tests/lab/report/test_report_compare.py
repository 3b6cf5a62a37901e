"""Cases beside each other: what is asked for, the numbers, the page and the command."""

from __future__ import annotations

import contextlib
import io
import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from scipy import stats

from dopslam_ros.bag import BagReader, BagWriter
from dopslam_ros.cli.main import main
from dopslam_ros.core.settings.layout import DOPPLER
from dopslam_ros.lab.report.cases import Case, bags_in, grouped, parse_case, run_cases
from dopslam_ros.lab.report.comparison import compare
from dopslam_ros.offline.metrics import nees
from dopslam_ros.offline.replay_result import Replay
from dopslam_ros.simulation.recording import write_simulation
from dopslam_ros.simulation.scenario import load_scenario
from dopslam_ros.system.errors import UsageError

if TYPE_CHECKING:
    from tests.lab.report.conftest import Browser

RUNS = 3


@pytest.fixture(scope="module")
def sims(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a few simulated runs."""
    folder = tmp_path_factory.mktemp("sims")
    for seed in range(RUNS):
        with BagWriter(folder / f"run{seed}", flush_seconds=None) as writer:
            write_simulation(load_scenario(scene), seed, writer)
    return folder


@pytest.fixture(scope="module")
def cases(sims: Path) -> list[Case]:
    """The runs as they are, and without Doppler."""
    return run_cases([parse_case(f"with={sims}"), parse_case(f"none={sims}:doppler=none")], {})


@pytest.mark.parametrize(
    ("text", "label", "path", "settings"),
    [
        ("runs/a", "runs/a", "runs/a", {}),
        ("here=runs/a", "here", "runs/a", {}),
        ("runs/a:gamma=1", "runs/a:gamma=1", "runs/a", {"gamma": 1}),
        ("one=runs/a:gamma=1,prune_type=0.01", "one", "runs/a", {"gamma": 1, "prune_type": 0.01}),
        ("a b=runs/x=y:doppler=none", "a b", "runs/x=y", {"doppler": "none"}),
        ("runs/x:y", "runs/x:y", "runs/x:y", {}),
        (
            "r:clutter_doppler=[-3, 3]",
            "r:clutter_doppler=[-3, 3]",
            "r",
            {"clutter_doppler": [-3, 3]},
        ),
    ],
)
def test_cases_are_read(text: str, label: str, path: str, settings: dict[str, Any]) -> None:
    """Name, bag and settings, each of which may be missing."""
    assert parse_case(text) == (label, (Path(path),), settings)


def test_a_path_that_exists_is_meant(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever characters it has."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a=b:gamma=1").mkdir()
    assert parse_case("a=b:gamma=1") == ("a=b:gamma=1", (Path("a=b:gamma=1"),), {})


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("bag:gama=1", "did you mean 'gamma'"),
        ("bag:gamma=0", r"gamma.*1 \.\. 1000"),
        ("bag:doppler=-1", "doppler=-1: give a standard deviation"),
        ("bag:doppler=maybe", "doppler=maybe"),
    ],
)
def test_settings_that_cannot_be_used(text: str, words: str) -> None:
    """They are refused before anything is filtered."""
    with pytest.raises(UsageError, match=words):
        parse_case(text)


def test_a_folder_of_bags_is_several_runs(sims: Path) -> None:
    """In the order of their names; a bag is itself."""
    assert bags_in(sims) == tuple(sims / f"run{n}" for n in range(RUNS))
    assert bags_in(sims / "run1") == (sims / "run1",)


def test_groups_must_match(sims: Path) -> None:
    """One case cannot be compared, nor three runs with one."""
    with pytest.raises(UsageError, match="nothing to compare with"):
        grouped([parse_case(str(sims))])
    with pytest.raises(UsageError, match="a: 3, b: 1"):
        grouped([parse_case(f"a={sims}"), parse_case(f"b={sims / 'run0'}")])


def test_doppler_is_left_out_of_this_case_only(cases: list[Case]) -> None:
    """Everything else is set as recorded."""
    first, second = (case.runs[0].parameters for case in cases)
    assert np.isfinite(first.measurement_noise_std[DOPPLER])
    assert np.isnan(second.measurement_noise_std[DOPPLER])
    assert first.measurement_noise_std[:DOPPLER] == second.measurement_noise_std[:DOPPLER]


def _errors(runs: tuple[Replay, ...]) -> np.ndarray:
    """(runs, K, 4) estimate minus truth, headings here far from the cut."""
    return np.array(
        [[o.state.ue_mean - run.truth[o.stamp_ns] for o in run.outputs] for run in runs]
    )


def test_the_numbers_of_the_table(cases: list[Case]) -> None:
    """Computed here in another way, from the estimates and the truth."""
    rows = compare(cases).summary["rows"]
    for row, case in zip(rows, cases, strict=True):
        errors = _errors(case.runs)
        position = np.sqrt((errors[..., :2] ** 2).sum(axis=-1).mean())
        assert row["position_rmse"]["value"] == pytest.approx(position)
        bound = np.mean(
            [
                [run.bounds[o.stamp_ns].with_doppler.peb ** 2 for o in run.outputs]
                for run in case.runs
            ]
        )
        assert row["position_to_bound"]["value"] == pytest.approx(position / np.sqrt(bound))
        every = [
            nees(o.state.ue_mean - run.truth[o.stamp_ns], o.state.ue_covariance)
            for run in case.runs
            for o in run.outputs
        ]
        assert row["nees_mean"]["value"] == pytest.approx(np.mean(every))
        assert row["nees_mean"]["low"] < row["nees_mean"]["value"] < row["nees_mean"]["high"]
    ratio = rows[1]["position_rmse"]["value"] / rows[0]["position_rmse"]["value"]
    assert rows[1]["to_first"]["position_rmse"]["value"] == pytest.approx(ratio)
    assert "to_first" not in rows[0]


def test_differences_are_those_of_pairs(cases: list[Case]) -> None:
    """Their mean and its interval are those of SciPy's paired t-test."""
    found = compare(cases)
    assert found.same_drives
    ours, theirs = (np.hypot(*np.moveaxis(_errors(c.runs)[..., :2], -1, 0)) for c in cases)
    expected = stats.ttest_rel(theirs, ours, axis=0).confidence_interval(0.95)
    columns = found.columns
    np.testing.assert_allclose(columns["less_position_1"], (theirs - ours).mean(axis=0), atol=1e-9)
    np.testing.assert_allclose(columns["less_low_position_1"], expected.low, atol=1e-9)
    np.testing.assert_allclose(columns["less_high_position_1"], expected.high, atol=1e-9)


def test_a_case_beside_itself(cases: list[Case]) -> None:
    """Is neither better nor worse."""
    first = cases[0]
    found = compare([first, Case("again", first.runs)])
    ratios = found.summary["rows"][1]["to_first"].values()
    assert all(r == pytest.approx({"value": 1.0, "low": 1.0, "high": 1.0}) for r in ratios)
    assert not found.columns["less_clock_1"].any()


def test_steps_that_one_lacks_do_not_count(cases: list[Case]) -> None:
    """Of the same drives."""
    whole = cases[0].runs[0]
    cut = Replay(whole.parameters, whole.outputs[:3], whole.bounds, whole.truth, whole.true_map)
    found = compare([Case("whole", (whole,)), Case("cut", (cut,))])
    assert found.same_drives and len(found.columns["time"]) == 3
    a, b = (row["position_rmse"]["value"] for row in found.summary["rows"])
    assert a == b


def test_different_drives_are_not_subtracted(cases: list[Case]) -> None:
    """There is no pair, so there are no ratios and no differences, and it is said."""
    one, other = (Case(name, (cases[0].runs[n],)) for n, name in enumerate("ab"))
    found = compare([one, other])
    assert not found.same_drives and not found.summary["same_drives"]
    assert all("to_first" not in row for row in found.summary["rows"])
    assert not any(name.startswith("less") for name in found.columns)


@dataclass(frozen=True)
class Compared:
    """What the command left: the page, the JSON, and what it said."""

    page: Path
    rows: list[Any]
    said: str


EVIL = "<b>bold & <img>"


@pytest.fixture(scope="module")
def compared(sims: Path, tmp_path_factory: pytest.TempPathFactory) -> Compared:
    """Three cases, one of them with a name that is markup."""
    folder = tmp_path_factory.mktemp("compared")
    page, result = folder / "page.html", folder / "result.json"
    asked = [f"{EVIL}={sims}", f"none={sims}:doppler=none", f"one={sims}:gamma=1"]
    with contextlib.redirect_stdout(io.StringIO()) as said:
        assert main(["compare", *asked, "--out", str(page), "--json", str(result)]) == 0
    return Compared(page, json.loads(result.read_text())["rows"], said.getvalue())


def test_the_command(compared: Compared, browser: Browser) -> None:
    """Tables on the terminal, the same numbers as JSON, a page that loads alone."""
    out, rows, said = compared.page, compared.rows, compared.said
    assert [row["case"] for row in rows] == [EVIL, "none", "one"]
    assert all(f"{row['position_rmse']['value']:.4f}" in said for row in rows)
    assert "on the same runs" in said and "nan" not in said
    browser.open(out)
    assert not browser.complaints()
    assert browser.requests() == [out.as_uri()]
    assert browser.run("return document.querySelectorAll('main img, header img').length") == 0
    assert EVIL in browser.run("return document.querySelector('h1').textContent")
    plots = browser.run("return charts.map(({plot}) => plot.querySelectorAll('.trace').length)")
    assert len(plots) == 11 and all(plots)
    table = browser.run("return document.getElementById('section-table').innerText")
    assert all(f"{row['position_rmse']['value']:.4f}" in table for row in rows)


def test_a_zoom_is_shared(compared: Compared, browser: Browser) -> None:
    """All charts over time show the same piece of it; the map of the tracks stays."""
    browser.show(compared.page)
    tracks = "return charts.at(-1).plot._fullLayout.xaxis.range"
    before = browser.run(tracks)
    browser.run("Plotly.relayout(charts[0].plot, {'xaxis.range': [1, 2]})")
    browser.wait("setTimeout(done, 300)")
    ranges = browser.run("return timed().map(({plot}) => plot._fullLayout.xaxis.range)")
    assert len(ranges) == 10 and all(found == [1, 2] for found in ranges)
    assert browser.run(tracks) == before
    assert not browser.complaints()


def test_bags_without_truth(
    sims: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], browser: Browser
) -> None:
    """There is no error to compare, which is said; step times and tracks are there."""
    bag, out = tmp_path / "bag", tmp_path / "page.html"
    with BagWriter(bag) as writer:
        for message in BagReader(sims / "run0").messages(
            {"/channel_measurements", "/odometry_control"}
        ):
            writer.add_topic(message.topic, message.type_name)
            writer.write(message.topic, message.payload, message.log_time_ns)
    assert main(["compare", str(bag), f"{bag}:gamma=1", "--out", str(out)]) == 0
    assert "nan" not in capsys.readouterr().out
    browser.open(out)
    assert not browser.complaints()
    assert "No truth" in browser.run("return document.querySelector('main').innerText")
    assert browser.run("return data.charts.map((chart) => chart.key)") == ["times", "tracks"]


def test_wrong_use(sims: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Says what is wrong, with exit code 2; a bag that is not there is a failure, 1."""
    assert main(["compare", str(sims / "run0")]) == 2
    assert "nothing to compare with" in capsys.readouterr().err
    assert main(["compare", str(sims / "run0"), f"{sims / 'run0'}:doppler=x"]) == 2
    assert "doppler=x" in capsys.readouterr().err
    assert main(["compare", str(tmp_path / "no"), str(sims / "run0")]) == 1
    assert "there is no bag" in capsys.readouterr().err
    with BagWriter(tmp_path / "empty") as writer:
        for name, info in BagReader(sims / "run0").topics.items():
            writer.add_topic(name, info.type_name)
    assert main(["compare", str(tmp_path / "empty"), str(sims / "run0")]) == 2
    assert "no measurement set" in capsys.readouterr().err
