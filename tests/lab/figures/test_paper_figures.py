"""Figures of a study beside the paper's: what is in them, and the table of ratios."""

from __future__ import annotations

import csv
import json
import math
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree import ElementTree

import matplotlib.image
import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from scipy.stats import gamma

from dopslam_ros.cli.main import main
from dopslam_ros.lab.figures.numbers import mean_square_band
from dopslam_ros.lab.figures.paper import FIGURES, draw_study, missing
from dopslam_ros.lab.figures.ratios import Ratio, all_ratios, write_ratios
from dopslam_ros.lab.figures.style import LOOKS, looks
from dopslam_ros.lab.study.labels import KINDS
from dopslam_ros.lab.study.plan import Plan
from dopslam_ros.lab.study.results import Results
from dopslam_ros.lab.study.run import FIELDS
from dopslam_ros.simulation.scenario import load_scenario

if TYPE_CHECKING:
    from tests.conftest import Processes

RUNS, STEPS = 7, 40
FILTERS = ("dead_reckoning", "joint", "genie", "marginal")
TABLES = ("ratios.md", "ratios.csv", "ratios.json")
PEB, HEB, CEB = 0.25, math.radians(0.2), 0.1


def made_up(
    filters: tuple[str, ...] = FILTERS,
    dopplers: tuple[float | None, ...] = (None, 0.1),
    scene: str = "paper",
) -> Results:
    """A study with random numbers of about the right size; bounds do not change."""
    rng = np.random.default_rng(5)
    tables = {}
    for label in filters:
        for doppler in dopplers:
            table = np.abs(rng.normal(1.0, 0.3, (RUNS, STEPS, len(FIELDS)))) + 0.01
            for field, value in (("peb", PEB), ("heb", HEB), ("ceb", CEB)):
                table[..., FIELDS.index(field)] = value
            if label in ("genie", "dead_reckoning"):
                table[..., FIELDS.index("correct_weight")] = np.nan
            tables[label, doppler] = table
    plan = Plan(load_scenario(scene), filters, dopplers, RUNS, 1)
    return Results(plan, tables)


def put(results: Results, label: str, doppler: float | None, **values: object) -> None:
    """Sets fields of a filter; a value may be one number, or (runs, steps)."""
    for field, value in values.items():
        results.tables[label, doppler][..., FIELDS.index(field)] = value


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with all that is made of the made-up study; to be read only."""
    folder = tmp_path_factory.mktemp("figures")
    results = made_up()
    assert draw_study(results, folder) == list(FIGURES)
    write_ratios(results, folder)
    return folder


@pytest.fixture(autouse=True)
def _close() -> Iterator[None]:
    """Figures that a test looked at."""
    yield
    plt.close("all")


def panels(figure: Figure) -> dict[str, Axes]:
    """The panels of a figure with one row, by their titles."""
    return {axes.get_title(): axes for axes in figure.axes}


def lines(axes: Axes) -> dict[str, np.ndarray]:
    """The lines of a panel by their names, as (points, 2)."""
    return {str(line.get_label()): np.asarray(line.get_xydata()) for line in axes.get_lines()}


WITH, WITHOUT = "with Doppler, 0.1 m/s", "without Doppler"
JOINT, MARGINAL = LOOKS["joint"].label, LOOKS["marginal"].label


# --- files ---------------------------------------------------------------------------------------


def test_every_figure_is_there_in_both_formats(written: Path) -> None:
    """Pictures with something in them, and vector graphics; no figure stays open."""
    pictures = {f"{name}.{suffix}" for name in FIGURES for suffix in ("png", "svg")}
    assert {path.name for path in written.iterdir()} == {*pictures, *TABLES}
    for name in FIGURES:
        image = np.asarray(matplotlib.image.imread(written / f"{name}.png"))[..., :3]
        assert image.shape[1] == 1350 and image.shape[0] > 400
        assert 0.01 < (image < 0.95).any(axis=2).mean() < 0.6
        root = ElementTree.parse(written / f"{name}.svg").getroot()
        assert root.tag.endswith("svg") and len(list(root.iter())) > 100
    for path in written.iterdir():
        marks = (b"<dc:date>", b"tIME", b"Creation Time")
        assert not any(mark in path.read_bytes() for mark in marks), "tells the time"
    assert not plt.get_fignums()


# --- what is drawn -------------------------------------------------------------------------------


def test_bounds_go_through_the_published_points() -> None:
    """Four panels; at the published noises our line is within 7 % of their points."""
    figure = FIGURES["bounds"].draw(made_up())
    assert [axes.get_title().split("[")[1] for axes in figure.axes] == ["m]", "deg]", "m]", "m]"]
    for axes in figure.axes:
        found = lines(axes)
        ours, theirs = found["with Doppler, ours"], found["with Doppler, published"]
        assert theirs[:, 0].tolist() == [0.05, 0.1, 0.2, 0.3, 0.4, 0.5]
        at_theirs = np.interp(theirs[:, 0], *ours.T)
        assert np.allclose(at_theirs / theirs[:, 1], 1.0, atol=0.07)
        level, their_level = found["without, ours"][0, 1], found["without, published"][0, 1]
        assert level == pytest.approx(their_level, rel=0.07)
        assert np.all(ours[:, 1] < level)
        assert axes.get_ylim()[0] == 0.0 and axes.get_ylim()[1] > max(level, their_level)


@pytest.mark.parametrize("landmarks", ["va", "sp"])
def test_gospa_is_the_mean_over_runs(landmarks: str) -> None:
    """Beside the published curve, with a standard error on both sides."""
    results = made_up()
    found = panels(FIGURES[f"gospa_{landmarks}"].draw(results))
    assert list(found) == [WITH, WITHOUT]
    table = results.field("joint", 0.1, f"gospa_{landmarks}")
    ours = lines(found[WITH])
    assert set(ours) == {JOINT, MARGINAL, "Ge et al., published"}
    assert np.allclose(ours[JOINT][:, 1], table.mean(axis=0))
    assert ours[JOINT][:, 0].tolist() == list(range(1, STEPS + 1))
    assert ours["Ge et al., published"][0, 1] == pytest.approx(math.sqrt(800.0))
    # The band after its own line: its outline holds mean + standard error at every step.
    outline = found[WITH].collections[0].get_paths()[0].vertices
    error = np.sqrt(((table - table.mean(axis=0)) ** 2).sum(axis=0) / (RUNS - 1) / RUNS)
    for step in (1, 17, STEPS):
        heights = outline[outline[:, 0] == step][:, 1]
        middle = table[:, step - 1].mean()
        assert heights.max() == pytest.approx(middle + error[step - 1])
        assert heights.min() == pytest.approx(middle - error[step - 1])


def test_bars_are_as_long_as_the_errors_with_the_bound_on_them() -> None:
    """Errors of 0.3 m and 0.4 m are 0.5 m of position; the paper's bars are hatched."""
    results = made_up()
    put(results, "joint", 0.1, error_x=0.3, error_y=-0.4, error_heading=math.radians(0.25))
    figure = FIGURES["rmse"].draw(results)
    position, heading, _ = figure.axes
    names = [text.get_text() for text in position.get_yticklabels()]
    assert names[:3] == [JOINT, MARGINAL, "Ge et al., published"] and len(names) == 5
    first = {
        axes: sorted(axes.patches, key=lambda bar: bar.get_y())[0] for axes in (position, heading)
    }
    assert first[position].get_width() == pytest.approx(0.5)
    assert first[heading].get_width() == pytest.approx(0.25)
    hatched = [bar.get_width() for bar in position.patches if bar.get_hatch()]
    assert sorted(hatched) == pytest.approx([0.5314, 0.6194])
    texts = [text.get_text() for text in position.texts]
    assert {"0.500", "0.531", "0.619"} <= set(texts) and len(texts) == 10
    marks = {segment[0][0] for mark in position.collections for segment in mark.get_segments()}
    assert list(marks) == pytest.approx([PEB])
    assert "RMSE of heading [deg]" in [axes.get_xlabel() for axes in figure.axes]


def test_dead_reckoning_does_not_squeeze_the_rest() -> None:
    """Its bar runs out of the panel and tells its length; alone, it has the panel."""
    results = made_up()
    put(results, "dead_reckoning", 0.1, error_x=60.0, error_y=80.0)
    position = FIGURES["rmse"].draw(results).axes[0]
    assert position.get_xlim()[1] < 5.0
    (text,) = (text for text in position.texts if "100.000" in text.get_text())
    assert text.get_position()[0] < position.get_xlim()[1] and text.get_ha() == "right"
    alone = made_up(("dead_reckoning",), (None,), "paper_bounds")
    put(alone, "dead_reckoning", None, error_x=60.0, error_y=80.0)
    assert FIGURES["rmse"].draw(alone).axes[0].get_xlim()[1] > 100.0


def test_weights_are_beside_the_published_mean() -> None:
    """Its mean and its ratio are in the legend; filters that associate nothing are left out."""
    results = made_up()
    put(results, "joint", 0.1, correct_weight=0.9)
    put(results, "joint", None, correct_weight=0.8)
    found = panels(FIGURES["association"].draw(results))
    # 0.9 / 0.8622 = 1.0438 and 0.8 / 0.6763 = 1.1829.
    texts = {title: list(lines(axes)) for title, axes in found.items()}
    assert texts[WITH][0] == f"{JOINT}: 0.900 = 1.04 × published"
    assert texts[WITHOUT][0] == f"{JOINT}: 0.800 = 1.18 × published"
    assert texts[WITHOUT][-1] == "Ge et al., published (mean): 0.676"
    assert len(texts[WITH]) == 3
    assert lines(found[WITH])[texts[WITH][-1]][:, 1].tolist() == [0.8622] * 2


def test_nees_is_beside_the_band_of_an_honest_filter() -> None:
    """The mean of n chi-square numbers with 4 degrees has a Gamma(2 n, 2 / n) distribution."""
    results = made_up()
    band = gamma.interval(0.95, 2 * RUNS, scale=2 / RUNS)
    assert mean_square_band(RUNS, 4) == pytest.approx(band)
    for title, axes in panels(FIGURES["nees"].draw(results)).items():
        doppler = 0.1 if title == WITH else None
        (patch,) = axes.patches
        box = patch.get_extents().transformed(axes.transData.inverted())
        assert (box.y0, box.y1) == pytest.approx(band)
        assert axes.get_yscale() == "log"
        for name in FILTERS:
            line = lines(axes)[LOOKS[name].label]
            assert np.allclose(line[:, 1], results.field(name, doppler, "nees").mean(axis=0))


def test_the_band_holds_what_it_says() -> None:
    """95 of 100 means of honest runs are in it: drawn, not computed."""
    rng = np.random.default_rng(2)
    for runs, dimension in ((3, 4), (25, 1)):
        errors = rng.standard_normal((20_000, runs, dimension))
        means = (errors**2).sum(axis=2).mean(axis=1)
        low, high = mean_square_band(runs, dimension)
        assert np.mean((means > low) & (means < high)) == pytest.approx(0.95, abs=0.006)


def test_errors_are_divided_by_the_bound() -> None:
    """RMSE over runs at each step, of the two axes together; NEES bands of one dimension."""
    results = made_up()
    growing = np.linspace(0.1, 2.0, STEPS)
    signs = np.where(np.arange(RUNS) % 2, 1.0, -1.0)[:, None]
    put(results, "marginal", None, error_x=3.0 * growing * signs, error_y=4.0 * growing)
    put(results, "marginal", None, error_heading=HEB * 1.5, error_clock=-0.2)
    figure = FIGURES["error_over_bound"].draw(results)
    assert len(figure.axes) == 6
    position, heading, clock = (lines(axes)[MARGINAL][:, 1] for axes in figure.axes[1::2])
    assert np.allclose(position, 5.0 * growing / PEB)
    assert np.allclose(heading, 1.5)
    assert np.allclose(clock, 2.0)
    box = figure.axes[1].patches[0].get_extents().transformed(figure.axes[1].transData.inverted())
    band = np.sqrt(gamma.interval(0.95, RUNS / 2, scale=2 / RUNS))
    assert (box.y0, box.y1) == pytest.approx(tuple(band))


def test_one_run_has_no_spread() -> None:
    """A study of one run is drawn, with no warning."""
    whole = made_up()
    tables = {case: table[:1] for case, table in whole.tables.items()}
    results = Results(whole.plan, tables, [0])
    for plot in FIGURES.values():
        plot.draw(results)


# --- studies that lack something -----------------------------------------------------------------


def test_what_is_missing_is_told() -> None:
    """A study of one filter with Doppler only: its panel is drawn, the rest is named."""
    results = made_up(("marginal",), (0.1,))
    assert list(panels(FIGURES["gospa_va"].draw(results))) == [WITH]
    absent = [f"filter {name}" for name in LOOKS if name != "marginal"]
    assert missing(results) == ["the paper's case without Doppler", *absent]
    assert missing(made_up(("marginal",), (None,)))[0] == f"the paper's case {WITH}"
    assert "genie, dead_reckoning in figure association" in missing(
        made_up(("genie", "dead_reckoning", "joint"))
    )


def test_a_figure_of_nothing_is_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a filter that makes a map and associations, three figures have nothing."""
    results, saved = made_up(("genie",)), []
    monkeypatch.setattr("dopslam_ros.lab.figures.paper.save", lambda *args: saved.append(args[1:]))
    names = draw_study(results, tmp_path)
    assert names == ["bounds", "rmse", "nees", "error_over_bound"]
    assert saved == [(tmp_path, name) for name in names]
    assert "figure gospa_va, which shows joint, marginal" in missing(results)
    assert any(text.startswith("figure association") for text in missing(results))


def test_runs_that_are_not_done_are_told() -> None:
    """A study that was stopped has fewer runs than planned."""
    whole = made_up(("joint",))
    tables = {case: table[:5] for case, table in whole.tables.items()}
    results = Results(whole.plan, tables, range(5))
    assert missing(results)[0] == f"2 of the {RUNS} runs"
    (axes, _) = FIGURES["nees"].draw(results).axes
    assert axes.get_ylabel() == "NEES, mean over 5 runs"


def test_another_scene_has_nothing_published_beside_it() -> None:
    """Only the bounds, which are always of the paper's scene, are compared."""
    results = made_up(scene="paper_bounds")
    assert "scene 'paper_bounds' is not the paper's" in missing(results)[0]
    for axes in FIGURES["gospa_va"].draw(results).axes:
        assert set(lines(axes)) == {JOINT, MARGINAL}
    assert not [bar for bar in FIGURES["rmse"].draw(results).axes[0].patches if bar.get_hatch()]
    assert {row.figure for row in all_ratios(results)} == {"bounds"}


def test_another_noise_has_nothing_published_beside_it() -> None:
    """The paper's filter ran with 0.1 m/s; a panel of its own for each noise."""
    results = made_up(("joint",), (None, 0.5, 0.1))
    found = panels(FIGURES["gospa_sp"].draw(results))
    assert list(found) == [WITH, "with Doppler, 0.5 m/s", WITHOUT]
    assert ["Ge et al., published" in lines(axes) for axes in found.values()] == [True, False, True]
    assert {row.sigma_d for row in all_ratios(results) if row.figure == "rmse"} == {0.1, None}


def test_every_filter_has_a_look() -> None:
    """Those of a study, and variants of them: no two look the same, even without colour."""
    assert set(KINDS) <= set(LOOKS)
    labels = [*LOOKS, "joint:gamma=1", "joint:gamma=20", "marginal:gamma=1"]
    found = looks(labels)
    assert list(found)[:3] == ["joint", "joint:gamma=1", "joint:gamma=20"]
    assert len({look.colour for look in found.values()}) == len(labels)
    assert len({(look.line, look.marker) for look in found.values()}) == len(labels)
    for look in found.values():
        assert np.dot(to_rgb(look.colour), (0.299, 0.587, 0.114)) < 0.8, "too light on white"


# --- the table -----------------------------------------------------------------------------------


def chosen(rows: list[Ratio], **wanted: object) -> list[Ratio]:
    """The rows whose fields are as wanted."""
    return [
        row for row in rows if all(getattr(row, name) == value for name, value in wanted.items())
    ]


def test_ratios_are_ours_over_theirs() -> None:
    """Numbers that can be checked by hand."""
    results = made_up()
    put(results, "joint", 0.1, error_x=0.3, error_y=0.4, error_heading=math.radians(0.178))
    put(results, "joint", 0.1, error_clock=0.1849, correct_weight=0.9, gospa_va=4.0)
    put(results, "joint", None, gospa_sp=np.tile(np.arange(1.0, 41.0), (RUNS, 1)))
    rows = all_ratios(results)
    mine = {"filter": "joint", "sigma_d": 0.1}
    position, heading, clock = chosen(rows, figure="rmse", **mine)
    assert (position.quantity, position.unit) == ("position", "m")
    assert (position.published, position.ours) == (0.5314, pytest.approx(0.5))
    assert position.ratio == pytest.approx(0.940911, abs=1e-6)
    assert (heading.unit, heading.ratio) == ("deg", pytest.approx(0.5))
    assert clock.ratio == pytest.approx(1.0)
    (weight,) = chosen(rows, figure="association", **mine)
    assert weight.ratio == pytest.approx(1.043841, abs=1e-6)
    second = chosen(rows, figure="gospa_va", step=2, **mine)
    assert [row.ratio for row in second] == [pytest.approx(4.0 / 16.1613435774681)]
    (last,) = chosen(rows, figure="gospa_sp", step=40, filter="joint", sigma_d=None)
    assert (last.ours, last.published) == (40.0, 2.05300503755635)
    bounds = chosen(rows, figure="bounds")
    assert len(bounds) == 28
    assert max(abs(row.ratio - 1.0) for row in bounds) < 0.07
    assert any(abs(row.ratio - 1.0) > 0.001 for row in bounds), "ours, not theirs again"


def test_every_published_number_is_in_the_table() -> None:
    """28 bounds; and for each filter 6 bars, 2 weights, 160 points of GOSPA."""
    rows = all_ratios(made_up(("joint", "genie")))
    for figure, count in (("bounds", 28), ("rmse", 12), ("association", 2)):
        assert len(chosen(rows, figure=figure)) == count
    for figure in ("gospa_va", "gospa_sp"):
        assert len(chosen(rows, figure=figure)) == 2 * 2 * STEPS


def test_the_three_tables_say_the_same(written: Path) -> None:
    """As JSON, as CSV, and to be read."""
    rows = all_ratios(made_up())
    content = json.loads((written / "ratios.json").read_text("utf-8"))["rows"]
    assert [Ratio(*list(row.values())[:-1]) for row in content] == rows
    assert [row["ratio"] for row in content] == [row.ratio for row in rows]
    with (written / "ratios.csv").open(encoding="utf-8", newline="") as file:
        table = list(csv.DictReader(file))
    assert [float(line["ratio"]) for line in table] == [row.ratio for row in rows]
    assert {line["sigma_d"] for line in table} >= {"0.1", "without"}
    text = (written / "ratios.md").read_text("utf-8")
    assert f"{RUNS} runs of scene 'paper', seed 1." in text
    assert "| sigma_d [m/s] | step | quantity | published | joint | marginal | genie |" in text
    place = ("gospa_sp", 9, "joint", 0.1)
    (row,) = (r for r in rows if (r.figure, r.step, r.filter, r.sigma_d) == place)
    assert f"| 0.1 | 9 | GOSPA [m] | 20.09 | {row.ours:#.4g} ({row.ratio:.3f}) |" in text
    assert text.count("\n## ") == 5


# --- the command ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory, scene: Path) -> Path:
    """A folder with a real study of a short scene; to be read only."""
    folder = tmp_path_factory.mktemp("study") / "short"
    asked = ["--filters", "joint", "genie", "--doppler", "0.1", "none", "--runs", "2"]
    assert main(["study", "--scenario", str(scene), *asked, "--workers=1", f"--out={folder}"]) == 0
    return folder


def test_a_study_is_drawn(
    study: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], processes: Processes
) -> None:
    """The folder that one command writes, the other draws; another process, the same bytes."""
    capsys.readouterr()
    out = tmp_path / "new" / "figures"
    file = tmp_path / "figures.json"
    assert main(["figures", str(study), "--out", str(out), "--json", str(file)]) == 0
    assert file.read_bytes() == (out / "ratios.json").read_bytes()
    said = capsys.readouterr().out.splitlines()
    assert said[0].startswith(f"in {out}: bounds, gospa_va, gospa_sp, rmse, association, nees")
    assert all(line.startswith("missing: ") for line in said[1:])
    assert "missing: filter marginal" in said
    assert "missing: genie in figure association" in said
    assert len(list(out.iterdir())) == 2 * len(FIGURES) + 3
    again = tmp_path / "again"
    process = processes.dopslam("figures", study, "--out", again)
    assert process.wait() == 0, process.stderr
    for path in out.iterdir():
        assert (again / path.name).read_bytes() == path.read_bytes(), path.name


def test_a_folder_that_holds_no_study_is_refused(
    study: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One line that says what is wrong, and nothing is made."""
    (tmp_path / "empty").mkdir()
    shutil.copytree(study, tmp_path / "damaged")
    part = next((tmp_path / "damaged" / "parts").rglob("*.npz"))
    part.write_bytes(part.read_bytes()[:100])
    shutil.copytree(study, tmp_path / "begun")
    shutil.rmtree(tmp_path / "begun" / "parts" / "joint")
    capsys.readouterr()
    for name, words in (
        ("nowhere", "holds no study"),
        ("empty", "holds no study"),
        ("damaged", f"'{part}' is damaged"),
        ("begun", "no run of the study is done by every filter"),
    ):
        out = tmp_path / "out"
        assert main(["figures", str(tmp_path / name), "--out", str(out)]) == 1
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith("dopslam: ") and words in line
        assert not out.exists()
