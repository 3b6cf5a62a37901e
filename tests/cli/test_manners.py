"""How the command treats people: hints, silence, completion, Ctrl-C."""

from __future__ import annotations

import contextlib
import io
import json
import os
import pkgutil
import re
import shlex
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from dopslam_ros.bag import BagReader
from dopslam_ros.cli import progress
from dopslam_ros.cli.main import COMMANDS, TALKERS, _parser, main
from dopslam_ros.cli.progress import silence, with_progress
from dopslam_ros.lab.bench.suite import BENCHMARKS
from dopslam_ros.lab.bench.titles import TITLES
from dopslam_ros.lab.study.labels import KINDS
from dopslam_ros.lab.study.names import FILTERS
from dopslam_ros.messages import topics
from dopslam_ros.simulation.scenes import builtin_scenarios
from dopslam_ros.system.stopping import Stop, until_stopped

Capture = pytest.CaptureFixture[str]


@pytest.mark.parametrize("command", sorted(COMMANDS))
def test_examples_are_understood(command: str) -> None:
    """The parser takes every example as it stands."""
    words = shlex.split(COMMANDS[command].EXAMPLE.partition(" > ")[0])
    assert words[:2] == ["dopslam", command]
    assert callable(_parser().parse_args(words[1:]).run)


def test_exit_codes_are_documented(capsys: Capture) -> None:
    """`dopslam --help` tells all four, and how to complete."""
    with pytest.raises(SystemExit):
        main(["--help"])
    text = capsys.readouterr().out.partition("exit codes:")[2]
    assert [line.split()[0] for line in text.splitlines()[1:5]] == ["0", "1", "2", "130"]
    assert "register-python-argcomplete dopslam" in text


@pytest.mark.parametrize(
    ("arguments", "right"),
    [
        (["replya", "x"], "replay"),
        (["parameters", "fliter"], "filter"),
        (["simulate", "--sead", "3", "--out", "x"], "--seed"),
        (["watch", "x", "--onse"], "--once"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else value,
)
def test_the_nearest_name(capsys: Capture, arguments: list[str], right: str) -> None:
    """Commands, choices and options that are misspelt."""
    with pytest.raises(SystemExit) as end:
        main(arguments)
    assert end.value.code == 2
    assert capsys.readouterr().err.strip().endswith(f"did you mean '{right}'?")


def test_the_nearest_file(tmp_path: Path, capsys: Capture) -> None:
    """A bag that is not there, beside one that is."""
    (tmp_path / "field_day").mkdir()
    assert main(["replay", str(tmp_path / "fieldday")]) == 1
    assert f"did you mean '{tmp_path / 'field_day'}'?" in capsys.readouterr().err
    assert main(["replay", str(tmp_path / "entirely-different")]) == 1
    assert "did you mean" not in capsys.readouterr().err


def test_quiet(tmp_path: Path, scene: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Nothing is said, but the work is done and errors are told; every command has it."""
    bag, file = tmp_path / "bag", tmp_path / "result.json"
    asked = ["simulate", "--scenario", str(scene), "--out", str(bag), "--json", str(file)]
    assert main([*asked, "--quiet"]) == 0
    assert capfd.readouterr() == ("", "")
    content = json.loads(file.read_text("utf-8"))
    assert content["snapshots"] == 8 and content["stopped"] is False
    assert main([*asked, "-q"]) == 1
    out, err = capfd.readouterr()
    assert out == "" and "exists already" in err and err.count("\n") == 1
    for command in set(COMMANDS) - set(TALKERS):
        with pytest.raises(SystemExit):
            main([command, "--help"])
        text = capfd.readouterr().out
        assert "--quiet" in text and "--json" in text, command


class Terminal(io.StringIO):
    """Keeps what is written, for those who draw on terminals."""

    def isatty(self) -> bool:
        return True


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> Terminal:
    """To stand in the place of standard error."""
    monkeypatch.setattr(progress, "REDRAW_SECONDS", 0.0)
    for name, value in {"TERM": "xterm", "COLUMNS": "100"}.items():
        monkeypatch.setenv(name, value)
    return Terminal()


def test_a_bar_counts_and_messages_stand_above_it(terminal: Terminal, capsys: Capture) -> None:
    """From what was done before, to all of them; results go to standard output."""
    seen = []
    with contextlib.redirect_stderr(terminal):
        for item in with_progress("abc", 5, "letters", done=2):
            seen.append(item)
            print(f"result {item}")
            print(f"dopslam: [{item}] failed", file=sys.stderr)
    assert seen == ["a", "b", "c"]
    assert capsys.readouterr().out == "result a\nresult b\nresult c\n"
    # Colours, and moves of the cursor to the beginning of what is drawn anew.
    lines = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]|\r", "\n", terminal.getvalue()).split("\n")
    assert [line.strip() for line in lines if "failed" in line] == [
        f"dopslam: [{item}] failed" for item in "abc"
    ]
    counts = [line.strip() for line in lines if re.fullmatch(r" *\d/5 *", line)]
    assert list(dict.fromkeys(counts)) == ["2/5", "3/5", "4/5", "5/5"]


def test_a_bar_leaves_the_terminal_as_it_was(terminal: Terminal) -> None:
    """Also when the loop is left, and where nobody knows how many there will be."""
    show, hide = "\x1b[?25h", "\x1b[?25l"  # the cursor
    with contextlib.redirect_stderr(terminal):
        with pytest.raises(KeyboardInterrupt):
            for item in with_progress(range(9), None, "numbers"):
                if item == 3:
                    assert sys.stderr is not terminal
                    raise KeyboardInterrupt
        assert sys.stderr is terminal
    assert "3/?" in terminal.getvalue()
    assert terminal.getvalue().rfind(show) > terminal.getvalue().rfind(hide) >= 0


def test_no_bar_without_a_terminal(terminal: Terminal, capfd: pytest.CaptureFixture[str]) -> None:
    """Nor when nothing is to be said."""
    with contextlib.redirect_stderr(terminal), silence(True):
        assert list(with_progress(range(3), 3, "numbers")) == [0, 1, 2]
    assert list(with_progress(range(3), 3, "numbers")) == [0, 1, 2]
    assert capfd.readouterr() == ("", "") and terminal.getvalue() == ""


def completions(line: str, tmp_path: Path) -> list[str]:
    """What the shell would offer at the end of a line."""
    out = tmp_path / "completions"
    environment = {
        **os.environ,
        "_ARGCOMPLETE": "1",
        "_ARGCOMPLETE_STDOUT_FILENAME": str(out),
        "_ARGCOMPLETE_IFS": "\n",
        "COMP_LINE": line,
        "COMP_POINT": str(len(line)),
    }
    command = [sys.executable, "-m", "dopslam_ros.cli.main"]
    subprocess.run(command, env=environment, check=True, capture_output=True)
    return [word.strip() for word in out.read_text().split("\n")]


def test_completion(tmp_path: Path) -> None:
    """Commands, options and the names of scenes."""
    assert {"replay", "report", "recover"} <= set(completions("dopslam re", tmp_path))
    assert "--json" in completions("dopslam replay --js", tmp_path)
    assert set(completions("dopslam simulate --scenario ", tmp_path)) >= set(builtin_scenarios())


HEAVY = {"matplotlib", "numba", "numpy", "plotly", "rclpy", "rich", "rosbags", "scipy"}


@pytest.mark.parametrize(
    ("start", "left_out"),
    [
        ("import dopslam_ros.cli.main as cli; cli._parser()", HEAVY),
        ("import dopslam_ros.nodes.filter", {"matplotlib", "plotly", "rich", "scipy.stats"}),
    ],
    ids=["help and completion", "a node"],
)
def test_nobody_waits_for_what_is_not_used(start: str, left_out: set[str]) -> None:
    """Compilers, ROS and libraries that draw are imported by what needs them alone."""
    code = f"{start}\nimport sys\nprint(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert not left_out & set(done.stdout.split())


def test_what_help_lists_is_there() -> None:
    """The names in help are those of what is imported later."""
    assert list(FILTERS) == list(KINDS)
    assert list(TITLES) == list(BENCHMARKS)


def test_ctrl_c_ends_a_loop_after_its_item() -> None:
    """The item it is at is finished; a second Ctrl-C does not wait; the handler is put back."""
    before = signal.getsignal(signal.SIGINT)

    def ended(outer: Stop, inner: Stop, times: int = 1) -> list[int]:
        seen = []
        with outer, inner:
            for item in until_stopped(range(9)):
                if item == 3:
                    for _ in range(times):
                        signal.raise_signal(signal.SIGINT)
                seen.append(item)
            assert outer.keep  # the loop has not ended as if all had been done
        return seen

    stop, inner = Stop(keep=True), Stop()
    assert ended(stop, inner) == [0, 1, 2, 3]
    assert stop.asked and stop.code() == 130 and not inner.asked
    for stop, times in ((Stop(), 1), (Stop(keep=True), 2)):
        with pytest.raises(KeyboardInterrupt):
            ended(stop, Stop(), times)
    with pytest.raises(KeyboardInterrupt), Stop():
        signal.raise_signal(signal.SIGINT)
        done = True  # what is no loop is done
    assert done
    assert signal.getsignal(signal.SIGINT) is before and Stop.in_force is None
    assert list(until_stopped(range(3))) == [0, 1, 2] and Stop().code() == 0


REPLAYED = "offline.replay_run.ReplayRun.feed"
# Where each command is when Ctrl-C comes: calling what is compiled.
COMPILED = {
    "simulate --scenario {scene} --out {new}": "simulation.recording.snapshot_messages",
    "replay {bag}": REPLAYED,
    "report {bag} --out {new}": REPLAYED,
    "compare {bag} {bag}:gamma=5 --json {new}": REPLAYED,
    "demo --scenario {scene} --out {new}": REPLAYED,
    "map {map} --json {new}": "core.pmb.estimates.reported_landmarks",
    "bounds --json {new}": "simulation.matched.nominal_bounds",
    "study --scenario {scene} --runs 1 --workers 1": "lab.study.run.judge_step",
    "inject --kinds kidnap none --json {new}": "lab.failure_injection.trial.trial",
    **{
        f"bench --quick --only {name} --json {{new}}": place
        for name, place in (
            ("step", "lab.bench.steps.step"),
            ("marginal", "lab.bench.steps.step"),
            ("map", "lab.bench.steps.step"),
            ("view", "lab.bench.steps.step"),
            ("replay", REPLAYED),
            ("soak", "lab.bench.soak.snapshot_messages"),
            ("bounds", "lab.bench.batch.BoundsSession.add_world"),
            ("gospa", "lab.bench.pieces.gospa"),
            ("assignment", "lab.bench.pieces.k_best_assignments"),
        )
    },
}


@pytest.mark.parametrize(("command", "place"), COMPILED.items(), ids=str)
def test_ctrl_c_is_no_exception_within_compiled_functions(
    command: str,
    place: str,
    tmp_path: Path,
    scene: Path,
    simulated: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: Capture,
) -> None:
    """It would be a SystemError or a crash there: it waits for the end of the step."""
    start, new = tmp_path / "start.dopmap", tmp_path / "new"
    if "{map}" in command:
        assert main(["replay", str(simulated), "--save-map", str(start)]) == 0
    monkeypatch.setattr("dopslam_ros.lab.demo.live_run.run_live", lambda *_: simulated)
    compiled, calls = pkgutil.resolve_name(f"dopslam_ros.{place}"), []

    def interrupted(*arguments: Any, **named: Any) -> Any:
        if not calls:
            signal.raise_signal(signal.SIGINT)
        calls.append(arguments)  # no exception came
        return compiled(*arguments, **named)

    monkeypatch.setattr(f"dopslam_ros.{place}", interrupted)
    before = signal.getsignal(signal.SIGINT)
    words = command.format(scene=scene, bag=simulated, map=start, new=new).split()
    assert main(words) == 130
    assert 1 <= len(calls) <= 3  # a step is one call, or one of each that is compared
    assert signal.getsignal(signal.SIGINT) is before
    said = capsys.readouterr().err.strip().splitlines()[-1]
    kept = words[0] in ("bounds", "replay", "simulate", "inject")
    assert said == "dopslam: stopped" + kept * "; what was done by then is kept"
    if words[0] == "bounds":
        assert len(json.loads(new.read_text("utf-8"))["rows"]) == 1
    if words[0] == "inject":
        content = json.loads(new.read_text("utf-8"))
        assert content["stopped"] and content["kinds"]["kidnap"]["runs"] == 1
        assert "none" not in content["kinds"]
    if words[0] == "simulate":
        assert BagReader(new).topics["/" + topics.CHANNEL_MEASUREMENTS.name].message_count == 1
    if words[0] in ("report", "compare", "map"):
        assert not new.exists()


def test_ctrl_c_keeps_what_was_done(
    tmp_path: Path, simulated: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    """A replay that is stopped writes a whole bag and a result of the steps until then."""
    from dopslam_ros.offline import replay_run

    filtered = replay_run.FilterSession.add_measurements

    def interrupted(self: object, stamp: int, measurements: object) -> object:
        if stamp == 2_500_000_000:  # the fourth set
            signal.raise_signal(signal.SIGINT)
        return filtered(self, stamp, measurements)  # type: ignore[arg-type]

    monkeypatch.setattr(replay_run.FilterSession, "add_measurements", interrupted)
    bag, file = tmp_path / "bag", tmp_path / "result.json"
    assert main(["replay", str(simulated), "--out", str(bag), "--json", str(file)]) == 130
    assert "kept" in capsys.readouterr().err
    content = json.loads(file.read_text("utf-8"))
    assert content["steps"] == 4 and content["stopped"] is True
    reader = BagReader(bag)
    assert reader.damage is None and (bag / "metadata.yaml").is_file()
    assert reader.topics["/" + topics.UE_STATE.name].message_count == 4
