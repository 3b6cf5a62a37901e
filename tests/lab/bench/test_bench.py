"""The benchmarks: what they set up, what they add up, what becomes of it. Not how fast it is."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import dopslam_ros
from dopslam_ros.cli.main import main
from dopslam_ros.core.pmb import initial_posterior, reported_landmarks
from dopslam_ros.lab.bench import batch, pieces, scaling, steps, suite
from dopslam_ros.lab.bench.records import (
    Figure,
    Measured,
    NotMeasured,
    Record,
    content_of,
    figure,
    milliseconds,
    read_record,
    times_as_long,
)
from dopslam_ros.lab.bench.suite import BENCHMARKS
from dopslam_ros.lab.bench.table import number
from dopslam_ros.simulation.matched import filter_parameters_for
from dopslam_ros.simulation.scenario import load_scenario
from dopslam_ros.simulation.simulator import nominal_trajectory, visible

FAST = ("step", "marginal", "map", "view", "bounds", "gospa", "assignment")


def test_statistics() -> None:
    found = figure("x", "m", [float(value) for value in range(101)])
    assert found == Figure("x", "m", 101, 0.0, 50.0, 99.0)
    short, long = milliseconds("a", [0.001, 0.002, 0.003]), milliseconds("b", [0.008])
    assert short.median == pytest.approx(2.0) and long.p99 == pytest.approx(8.0)
    ratio = times_as_long(long, short)
    assert ratio.name == "b / a" and ratio.value == pytest.approx(4.0)
    record = Record("n", "t", Measured((short, long), (ratio,), ("note",)))
    assert read_record(json.loads(json.dumps(content_of(record)))) == record


@pytest.mark.parametrize(
    "value, text",
    [(0.0, "0"), (0.0041234, "0.00412"), (13.26, "13.3"), (999.6, "1,000"), (123456.7, "123,457")],
)
def test_numbers(value: float, text: str) -> None:
    assert number(value) == text


@pytest.mark.parametrize("power", [0.0, 0.7, 2.0])
def test_growth_exponent(power: float) -> None:
    sizes = [10, 20, 50, 100]
    assert scaling.growth_exponent(sizes, [3.0 * n**power for n in sizes]) == pytest.approx(power)


def test_the_street_has_in_view_what_it_says() -> None:
    scenario = scaling.street(10, 40, 30)
    for step, state in enumerate(nominal_trajectory(scenario)):
        seen = visible(scenario, state, step)
        assert seen[:11].all() and not seen[11:].any()  # the BS is the first one


def test_the_map_in_the_filter_is_the_one_given() -> None:
    """Positions, and covariances of their own error and the vehicle's together."""
    scenario = scaling.street(10, 240, 1)
    parameters = filter_parameters_for(scenario)
    state = scaling.with_map(parameters, scenario.landmarks, scenario.landmark_types)
    assert len(state.density.track_id) == 10 and len(state.inactive[0]) == 240
    found = reported_landmarks(state, parameters)
    assert found.ids.tolist() == list(range(1, 251))
    np.testing.assert_allclose(found.positions, scenario.landmarks, atol=1e-6)
    vehicle = np.diag([*np.square(parameters.initial_std[:2]), 0.0])
    expected = scaling.KNOWN_STD**2 * np.eye(3) + vehicle
    np.testing.assert_allclose(found.covariances, np.tile(expected, (250, 1, 1)), atol=1e-6)
    assert np.linalg.eigvalsh(state.density.covariance)[0] > 0.0


def test_tasks_take_turns() -> None:
    calls: list[str] = []

    def noted(name: str) -> Any:
        return lambda density, inputs: calls.append(f"{name}{density}{inputs}") or density + 1

    run: Any = ["x", "y"]
    seconds = steps.step_seconds(steps.Task(noted("a"), 0, run), steps.Task(noted("b"), 5, run))
    assert calls == ["a0x", "b5x", "a1y", "b6y"]
    assert [len(one) for one in seconds] == [2, 2]


def test_inputs_are_those_of_the_filter() -> None:
    scenario = load_scenario("paper")
    run = steps.inputs_of(scenario, 1)
    assert len(run) == 40 and run[0].spans == () and run[7].spans[0].duration == 0.5
    parameters = filter_parameters_for(scenario)
    state = initial_posterior(parameters)
    for inputs in run[:3]:
        state = steps.filter_step(parameters)(state, inputs)
    assert state.density.undetected.looks == 3


def test_without_a_checkout_the_textbook_is_said_to_be_absent(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(dopslam_ros, "__file__", str(tmp_path / "dopslam_ros" / "__init__.py"))
    monkeypatch.delitem(steps.sys.modules, "dopslam_textbook", raising=False)
    measured = steps.marginal(quick=True)
    assert [one.name for one in measured.figures] == ["step"] and not measured.ratios
    assert "run from a checkout" in measured.notes[0]


def test_solvers_that_disagree_are_not_compared() -> None:
    agreed = pieces.in_turns([(1.0,), (2.0,)], lambda x: x, lambda x: x + 1e-9)
    assert [len(one) for one in agreed] == [2, 2]
    with pytest.raises(RuntimeError, match="disagree"):
        pieces.in_turns([(1.0,), (2.0,)], lambda x: x, lambda x: x**2)


def test_memory_is_measured_in_a_process_of_its_own() -> None:
    found = batch.in_a_child(batch.endless, 2, 45)
    assert 2**24 < found.before <= found.after < 2**32
    assert 0.0 < found.smallest < 1.0 and found.asymmetry == 0.0
    assert batch.in_a_child(os.getpid) != os.getpid()
    with pytest.raises(RuntimeError, match="the process that computed _exit died"):
        batch.in_a_child(os._exit, 3)


@pytest.mark.parametrize(
    ("matrix", "smallest", "asymmetry"),
    [
        ([[4.0, 0.0], [0.0, 1e-6]], 1.0, 0.0),
        ([[4.0, 1.0], [1.0, 1.0]], 0.5, 0.0),
        ([[4.0, 1.0], [1.002, 1.0]], 0.499, 0.001),
        ([[4.0, 3.0], [3.0, 1.0]], -0.5, 0.0),
        ([[4.0, 0.0], [0.0, -1.0]], -np.inf, np.inf),
        ([[4.0, np.nan], [np.nan, 1.0]], -np.inf, np.inf),
    ],
    ids=["diagonal", "correlated", "asymmetric", "indefinite", "negative", "no number"],
)
def test_what_is_no_covariance_is_seen(
    matrix: list[list[float]], smallest: float, asymmetry: float
) -> None:
    found = batch.spectrum(np.array(matrix))
    assert found == pytest.approx((smallest, asymmetry), abs=1e-9)


def test_a_covariance_that_is_none_fails_the_benchmark(monkeypatch: pytest.MonkeyPatch) -> None:
    def found(function: object, *arguments: int) -> batch.Endless:
        return batch.Endless(1, 1, -1e-17, 0.0)

    monkeypatch.setattr(batch, "in_a_child", found)
    with pytest.raises(RuntimeError, match="eigenvalue -1e-17"):
        batch.memory(True)


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Quick, from the measurement to the document, and the document again from the JSON."""
    files = tmp_path / "b.json", tmp_path / "b.md", tmp_path / "again.md"
    arguments = ["--quick", "--json", str(files[0]), "--markdown", str(files[1])]
    assert main(["bench", "--only", *FAST, *arguments]) == 0
    printed = capsys.readouterr()
    content = json.loads(files[0].read_text("utf-8"))
    assert [record["name"] for record in content["records"]] == list(FAST)
    assert content["quick"] and content["machine"]["cores"] >= 1 and content["machine"]["cpu"]
    for record in content["records"]:
        assert record["figures"] and record["ratios"] and not record["notes"], record["name"]
        medians = {}
        for one in record["figures"]:
            assert 0.0 < one["minimum"] <= one["median"] <= one["p99"] and one["count"] >= 1
            medians[one["name"]] = one["median"]
        for ratio in record["ratios"]:
            over, slash, under = ratio["name"].partition(" / ")
            if slash and over in medians and under in medians:
                assert ratio["value"] == pytest.approx(medians[over] / medians[under])
        assert f"{record['name']}: {record['title']}" in printed.out
        assert f"/{len(FAST)} {record['name']} ..." in printed.err
    assert main(["bench", "--from", str(files[0]), "--markdown", str(files[2])]) == 0
    assert capsys.readouterr().out == printed.out
    text = files[1].read_text("utf-8")
    assert files[2].read_text("utf-8") == text
    assert "`--quick`" in text and all(f"\n## {name}\n" in text for name in FAST)


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["--only", "stpe"], "unknown benchmark 'stpe': did you mean 'step'?"),
        (["--from", "here.json", "--quick"], "--from measures nothing"),
        (["--from", "nowhere.json"], "nowhere.json: No such file"),
        (["--from", "odd.json"], "not what 'dopslam bench --json' writes"),
        (["--markdown", "nowhere/b.md"], "give a file in a folder that exists"),
    ],
)
def test_asked_wrongly(
    arguments: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "odd.json").write_text('{"records": 3}', "utf-8")
    assert main(["bench", *arguments]) == 2
    assert message in capsys.readouterr().err


def some_figure(quick: bool) -> Measured:
    assert quick
    return Measured((figure("thing", "s", [1.0, 2.0]),))


def stopped(quick: bool) -> Measured:
    raise KeyboardInterrupt


def broken(quick: bool) -> Measured:
    raise ValueError("the fault")


def absent(quick: bool) -> Measured:
    raise NotMeasured("nothing there")


@pytest.mark.parametrize(
    "second, code, note",
    [(stopped, 130, None), (broken, 1, "failed: ValueError: the fault"), (absent, 0, "nothing")],
)
def test_what_is_done_is_kept(
    second: Any,
    code: int,
    note: str | None,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """On Ctrl-C, when a benchmark fails, and when something it needs is not there."""
    for name, run in (("step", some_figure), ("view", second), ("map", some_figure)):
        monkeypatch.setitem(BENCHMARKS, name, run)
    file = tmp_path / "b.json"
    arguments = ["--quick", "--only", "step", "view", "map", "--json", str(file)]
    assert main(["bench", *arguments]) == code
    records = [read_record(one) for one in json.loads(file.read_text("utf-8"))["records"]]
    assert records[0].measured == some_figure(True)
    assert "thing [s]" in capsys.readouterr().out
    if note is None:
        assert [record.name for record in records] == ["step"]
    else:
        assert note in records[1].measured.notes[0] and records[2] == suite.measure("map", True)
