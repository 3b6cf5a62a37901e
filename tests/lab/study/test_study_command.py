"""`dopslam study`: what it prints and leaves behind, however it ended and whoever computed it."""

from __future__ import annotations

import json
import os
import shutil
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from dopslam_ros.cli.main import main
from dopslam_ros.lab.study import executors
from dopslam_ros.lab.study.plan import Plan, Task
from dopslam_ros.lab.study.results import load_results
from dopslam_ros.lab.study.run import FIELDS, Part, run_task

if TYPE_CHECKING:
    from tests.conftest import Process, Processes

Capture = pytest.CaptureFixture[str]
STEPS = 8
# What must not depend on how a study was done.
NUMBERS = ("plan.json", "summary.json", "summary.csv", "steps.csv")
FILTERS = ("joint", "dead_reckoning", "marginal:gamma=3")
STUDY = ("--filters", *FILTERS, "--doppler", "0.1", "none", "--runs", "4", "--seed", "2")


def run(*arguments: object) -> int:
    return main(["study", *map(str, arguments)])


def strict(path: Path) -> Any:
    """The content of a JSON file that has neither NaN nor Infinity."""

    def refuse(name: str) -> None:
        raise AssertionError(f"{name} is no JSON")

    return json.loads(path.read_text("utf-8"), parse_constant=refuse)


def numbers(folder: Path) -> dict[str, bytes]:
    return {name: (folder / name).read_bytes() for name in NUMBERS}


def parts(folder: Path) -> list[Path]:
    return sorted((folder / "parts").rglob("*.npz"))


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory, scene: Path) -> Path:
    """The folder of a study done in one go in one process; to be read only."""
    folder = tmp_path_factory.mktemp("study") / "whole"
    assert run("--scenario", scene, *STUDY, "--workers", 1, "--out", folder) == 0
    return folder


# --- what it gives -------------------------------------------------------------------------------


def test_the_files_of_a_study(whole: Path) -> None:
    assert sorted(path.name for path in whole.iterdir()) == sorted(
        [*NUMBERS, "parts", "timing.json"]
    )
    assert len(parts(whole)) == 3 * 2 * 4 and not list(whole.rglob("*.tmp"))
    summary = strict(whole / "summary.json")
    assert [(row["filter"], row["doppler"]) for row in summary["rows"]] == [
        (label, doppler) for doppler in (0.1, None) for label in FILTERS
    ]
    assert (summary["scenario"], summary["seed"], summary["steps"]) == ("short", 2, STEPS)
    assert summary["runs"] == summary["runs_planned"] == 4
    weight = summary["rows"][1]["correct_association_weight"]
    assert weight == {"value": None, "low": None, "high": None}
    timing = strict(whole / "timing.json")["rows"]
    assert len(timing) == 6
    # The slowest step may be the one that the kernels were compiled for.
    assert all(0.0 < row["step_ms_p50"] <= row["step_ms_p99"] for row in timing)
    assert all(row["step_ms_p50"] < 1e3 for row in timing)
    assert all(row["steps"] == 4 * STEPS for row in timing)


def test_the_tables_are_the_results(whole: Path) -> None:
    """steps.csv has every number of every run, summary.csv what summary.json has."""
    results = load_results(whole)
    header, *lines = (line.split(",") for line in (whole / "steps.csv").read_text().splitlines())
    # The label with settings has no comma here: csv would put quotes around it.
    assert header == ["filter", "doppler", "run", "step", *FIELDS]
    assert len(lines) == 6 * 4 * STEPS
    for label, doppler, number, step, *cells in lines:
        case = (label, None if doppler == "none" else float(doppler))
        row = results.tables[case][int(number), int(step) - 1]
        assert cells == ["" if value != value else repr(value) for value in row.tolist()]
    header, *lines = (line.split(",") for line in (whole / "summary.csv").read_text().splitlines())
    for cells, row in zip(lines, strict(whole / "summary.json")["rows"], strict=True):
        found = dict(zip(header, cells, strict=True))
        assert found["filter"] == row["filter"]
        for name in ("position_rmse", "gospa_sp", "nees_mean"):
            assert float(found[name]) == row[name]["value"]
            assert float(found[f"{name}_high"]) == row[name]["high"]
        ratio = row.get("to_first", {}).get("position_rmse", {"low": ""})["low"]
        assert found["position_rmse_to_first_low"] == (repr(ratio) if ratio else "")


def test_what_is_printed(whole: Path, scene: Path, capsys: Capture, tmp_path: Path) -> None:
    """A study that is done is not done again, but told again; --json is its summary."""
    before = {path: path.stat().st_mtime_ns for path in parts(whole)}
    file = tmp_path / "s.json"
    assert run("--scenario", scene, *STUDY, "--out", whole, "--json", file) == 0
    assert {path: path.stat().st_mtime_ns for path in parts(whole)} == before
    assert file.read_bytes() == (whole / "summary.json").read_bytes()
    captured = capsys.readouterr()
    assert captured.err == ""
    lines = captured.out.splitlines()
    assert lines[0] == f"scene 'short', 4 runs of {STEPS} steps, seed 2"
    for row in strict(whole / "summary.json")["rows"]:
        doppler = "none" if row["doppler"] is None else "0.1 m/s"
        mine = [line for line in lines if line.split()[:1] == [row["filter"]] and doppler in line]
        assert len(mine) == (3 if "to_first" in row else 2)
        accuracy, consistency, *compared = mine
        assert f" {row['position_rmse']['value']:.4f} " in accuracy
        ratio = row["position_to_bound"]
        assert f"{ratio['value']:.2f} [{ratio['low']:.2f}, {ratio['high']:.2f}]" in accuracy
        assert f"{row['nees_mean']['value']:.2f} [" in consistency
        for line in compared:
            ratio = row["to_first"]["position_rmse"]
            assert f"{ratio['value']:.2f} [{ratio['low']:.2f}, {ratio['high']:.2f}]" in line


def test_defaults_are_those_of_the_scene(tmp_path: Path, scene: Path) -> None:
    """The joint filter with the scene's Doppler; a scene without Doppler has none."""
    other = tmp_path / "other.yaml"
    other.write_text(
        scene.read_text() + "measurement_noise_std: [0.1, 0.05, 0.05, 0.05, 0.05, .nan]\n"
    )
    for path, doppler in ((scene, 0.1), (other, None)):
        file = tmp_path / "s.json"
        assert run("--scenario", path, "--runs", 1, "--workers", 1, "--json", file) == 0
        (row,) = strict(file)["rows"]
        assert (row["filter"], row["doppler"]) == ("joint", doppler)
        assert strict(file)["seed"] == 1


def test_settings_of_all_filters(tmp_path: Path, scene: Path) -> None:
    """--param and --params are for every filter, and part of the study."""
    file, found = tmp_path / "s.json", []
    (tmp_path / "f.yaml").write_text("gamma: 1\n")
    command = ["--scenario", scene, "--runs", 1, "--workers", 1, "--json", file]
    for options in ([], ["--param", "gamma=1"], ["--params", tmp_path / "f.yaml"]):
        assert run(*command, *options, "--out", tmp_path / f"{len(found)}") == 0
        found.append(strict(file)["rows"][0]["position_rmse"]["value"])
        assert strict(file)["settings"] == ({"gamma": 1} if options else {})
    assert found[0] != found[1] == found[2]
    assert run(*command, "--out", tmp_path / "1") == 1


# --- the same numbers however it was done --------------------------------------------------------


def test_workers_change_no_byte(whole: Path, scene: Path, tmp_path: Path) -> None:
    folder = tmp_path / "two"
    assert run("--scenario", scene, *STUDY, "--workers", 2, "--out", folder) == 0
    assert numbers(folder) == numbers(whole)


def test_a_study_that_grew_is_the_same(whole: Path, scene: Path, tmp_path: Path) -> None:
    """First less of everything, in another order; then all of it."""
    folder = tmp_path / "grown"
    command = ["--scenario", scene, "--seed", 2, "--workers", 1, "--out", folder]
    assert run(*command, "--filters", FILTERS[1], "--doppler", "none", "--runs", 2) == 0
    assert run(*command, "--filters", *FILTERS[::-1], "--doppler", 0.1, "--runs", 1) == 0
    assert run(*command, *STUDY) == 0
    assert numbers(folder) == numbers(whole)


def test_a_killed_study_goes_on(
    whole: Path, scene: Path, processes: Processes, wait: Callable[..., None]
) -> None:
    """SIGKILL at any moment: no worker is left, what was done is kept, the rest is done."""
    folder = processes.folder / "killed"
    command = ["--scenario", scene, *STUDY, "--out", folder]
    process = processes.dopslam("study", *command, "--workers", 2)
    wait(lambda: len(parts(folder)) >= 4)
    workers = children(process.popen.pid)
    process.popen.kill()
    process.wait()
    wait(lambda: not any(map(running, workers)), 10.0)
    kept = {path: path.stat().st_mtime_ns for path in parts(folder)}
    assert 4 <= len(kept) < 24
    assert run(*command, "--workers", 1) == 0
    assert kept.items() <= {path: path.stat().st_mtime_ns for path in parts(folder)}.items()
    assert numbers(folder) == numbers(whole)
    assert not list(folder.rglob("*.tmp"))


def test_damaged_parts_are_done_again(
    whole: Path, scene: Path, tmp_path: Path, capsys: Capture
) -> None:
    folder = tmp_path / "damaged"
    shutil.copytree(whole, folder)
    broken = parts(folder)[3::9]
    for path in broken:
        path.write_bytes(path.read_bytes()[:-50])
    assert run("--scenario", scene, *STUDY, "--workers", 1, "--out", folder) == 0
    said = capsys.readouterr().err
    for path in broken:
        assert f"'{path}' is damaged" in said and "computed anew" in said
    assert f"{24 - len(broken)} of 24 tasks are done already" in said
    assert numbers(folder) == numbers(whole)


# --- what goes wrong -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["--filters", "joint", "jiont"], 2, ["'jiont'", "did you mean 'joint'"]),
        (["--filters", "joint:gama=3"], 2, ["joint:gama=3", "did you mean 'gamma'"]),
        (["--filters", "joint", "joint"], 1, ["filter joint is given twice"]),
        (["--doppler", "0.1", "none", "0.1"], 1, ["Doppler noise 0.1 is given twice"]),
        (["--param", "coupling=marginal"], 2, ["coupling = joint, not marginal"]),
        (["--seed", "3", "--out", "{whole}"], 1, ["whole", "seed is 3, there 2", "--out"]),
        (["--out", "{tmp}"], 1, ["is not empty and holds no study"]),
        (["--out", "{tmp}/file"], 1, ["file"]),
        (["--scheduler", "tcp://x:1", "--workers", "2"], 2, ["--workers", "--scheduler"]),
        (["--scheduler", "x"], 1, ["Dask"]),
        (["--json", "{tmp}/no/s.json"], 2, ["s.json", "folder that exists"]),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else None,
)
def test_what_cannot_be_done(
    whole: Path,
    scene: Path,
    tmp_path: Path,
    capsys: Capture,
    arguments: list[str],
    code: int,
    words: list[str],
) -> None:
    """The last line names what is wrong; nothing is computed, nothing is changed."""
    (tmp_path / "file").touch()
    before = numbers(whole)
    texts = [argument.format(tmp=tmp_path, whole=whole) for argument in arguments]
    assert run("--scenario", scene, "--runs", 1, *texts) == code
    captured = capsys.readouterr()
    assert captured.out == ""
    line = captured.err.strip().splitlines()[-1]
    for word in words:
        assert word in line, line
    assert "Traceback" not in captured.err
    assert numbers(whole) == before
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_tasks_that_fail(
    whole: Path, scene: Path, tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The others are done, what failed is told, exit code 1; the same command tries it again."""
    bad = Task("joint", None, 2)

    def fail(plan: Plan, task: Task) -> Part:
        if task == bad:
            raise FloatingPointError("by design")
        return run_task(plan, task)

    folder = tmp_path / "failing"
    command = ["--scenario", scene, *STUDY, "--workers", 1, "--out", folder]
    with monkeypatch.context() as patch:
        patch.setattr("dopslam_ros.lab.study.run.run_task", fail)
        assert run(*command) == 1
    captured = capsys.readouterr()
    assert captured.out.startswith(f"scene 'short', 3 of 4 runs of {STEPS} steps")
    said = captured.err.splitlines()
    assert f"dopslam: {bad} failed: FloatingPointError: by design" in said
    assert said[-2] == f"dopslam: 1 tasks failed: see {folder / 'failures.txt'}"
    assert "1 tasks are not done" in said[-1] and "the same command" in said[-1]
    assert "Traceback" in (folder / "failures.txt").read_text()
    assert len(parts(folder)) == 23
    # The runs that are whole are those of the study without the one that failed.
    partial, complete = load_results(folder), load_results(whole)
    assert list(partial.run_numbers) == [0, 1, 3]
    for case, table in complete.tables.items():
        assert partial.tables[case].tobytes() == table[[0, 1, 3]].tobytes()
    assert run(*command) == 0
    assert numbers(folder) == numbers(whole)
    assert not (folder / "failures.txt").exists()


def test_when_all_fail(scene: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    """A few are told one by one, the rest is counted."""

    def fail(plan: Plan, task: Task) -> Part:
        raise FloatingPointError("by design")

    monkeypatch.setattr("dopslam_ros.lab.study.run.run_task", fail)
    assert run("--scenario", scene, "--runs", 30, "--workers", 1) == 1
    captured = capsys.readouterr()
    assert captured.out == ""
    said = captured.err.splitlines()
    assert len(said) < 10
    assert "30 tasks failed, give --out to keep why" in said[-2]


def test_threads_of_blas_are_told(
    scene: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dopslam_ros.lab.study.executors.blas_is_limited", lambda: False)
    command = ["--scenario", scene, "--filters", "dead_reckoning", "--runs", 1, "--workers", 1]
    assert run(*command) == 0
    assert "'threadpoolctl', or set OMP_NUM_THREADS=1" in capsys.readouterr().err


# --- Ctrl-C --------------------------------------------------------------------------------------


def children(parent: int) -> list[int]:
    text = Path(f"/proc/{parent}/task/{parent}/children").read_text("utf-8")
    return [int(child) for child in text.split()]


def running(process: int) -> bool:
    """Whether a process is there and no zombie."""
    try:
        text = Path(f"/proc/{process}/stat").read_text("utf-8")
    except OSError:
        return False
    return text.rpartition(")")[2].split()[0] != "Z"


def busy_seconds(process: int) -> float:
    """How long a process has computed."""
    text = Path(f"/proc/{process}/stat").read_text("utf-8")
    return int(text.rpartition(")")[2].split()[11]) / os.sysconf("SC_CLK_TCK")


def check_stopped(process: Process, code: int) -> None:
    """It ended at Ctrl-C and said so."""
    assert code == 130, process.stderr
    assert "Traceback" not in process.stderr
    assert process.stderr.strip().splitlines()[-1] == "dopslam: stopped"


@pytest.mark.parametrize("workers", [1, 2])
def test_ctrl_c_keeps_what_is_done(
    processes: Processes, scene: Path, wait: Callable[..., None], workers: int
) -> None:
    """What has not begun is given up; the summary of the rest is printed, and how to go on."""
    folder = processes.folder / "stopped"
    process = processes.dopslam(
        "study", "--scenario", scene, "--runs", 3000, "--workers", workers, "--out", folder
    )
    wait(lambda: len(parts(folder)) >= 4)
    begin = time.monotonic()
    check_stopped(process, process.stop())
    assert time.monotonic() - begin < 10.0
    done = len(parts(folder))
    assert 4 <= done < 3000
    runs = strict(folder / "summary.json")["runs"]
    assert process.stdout.startswith(f"scene 'short', {runs} of 3000 runs of {STEPS} steps")
    assert len(load_results(folder).run_numbers) == runs
    left = process.stderr.strip().splitlines()[-2]
    assert left.startswith(f"dopslam: {3000 - done} tasks are not done")
    assert str(folder) in left and "the same command goes on" in left


def test_ctrl_c_in_a_terminal_reaches_the_workers(
    processes: Processes, tmp_path: Path, wait: Callable[..., None]
) -> None:
    """A terminal sends Ctrl-C to all: the workers, one of them idle, say nothing of it."""
    file = tmp_path / "long.yaml"
    controls = "[{steps: 150, speed: 22.22, turn_rate: 0.3141592653589793}]"
    file.write_text(f"base: paper\ncontrols: {controls}\n", "utf-8")
    filters = ("joint", "dead_reckoning")
    process = processes.dopslam(
        "study", "--scenario", file, "--filters", *filters, "--runs", 1, "--workers", 2
    )
    wait(lambda: sum(busy_seconds(child) > 0.2 for child in children(process.popen.pid)) >= 1)
    check_stopped(process, process.interrupt_all())
    assert "give --out to keep what is done" in process.stderr
    assert not process.stdout


def test_a_broken_pool_keeps_what_is_done(
    processes: Processes, scene: Path, wait: Callable[..., None]
) -> None:
    """A worker that the system kills, as it does for want of memory, ends the study cleanly."""
    folder = processes.folder / "broken"
    process = processes.dopslam(
        "study", "--scenario", scene, "--runs", 3000, "--workers", 2, "--out", folder
    )
    wait(lambda: len(parts(folder)) >= 4)
    os.kill(children(process.popen.pid)[0], signal.SIGKILL)
    assert process.wait() == 1
    *_, left, why = process.stderr.strip().splitlines()
    assert "tasks are not done" in left and "the same command" in left
    assert "a worker process was killed" in why and "Traceback" not in process.stderr
    assert strict(folder / "summary.json")["runs"] >= 1


def test_a_cluster_gives_the_same_bytes(
    whole: Path, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """--scheduler leads to Dask (test_study_executors has the real thing)."""
    asked = []

    def instead(plan: Plan, tasks: Any, address: str, say: object) -> Any:
        asked.append(address)
        return executors.run_local(plan, tasks[::-1], 1)

    monkeypatch.setattr("dopslam_ros.lab.study.executors.run_on_dask", instead)
    folder = tmp_path / "cluster"
    command = ["--scenario", scene, *STUDY, "--scheduler", "tcp://there:8786", "--out", folder]
    assert run(*command) == 0
    assert asked == ["tcp://there:8786"]
    assert numbers(folder) == numbers(whole)
