"""How the command treats people: hints, silence, completion, Ctrl-C."""

from __future__ import annotations

import json
import os
import shlex
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from dopslam_ros import topics
from dopslam_ros.bag import BagReader
from dopslam_ros.bench.suite import BENCHMARKS
from dopslam_ros.bench.titles import TITLES
from dopslam_ros.cli import COMMANDS, TALKERS, _parser, main
from dopslam_ros.options import Stop
from dopslam_ros.scenarios import builtin_scenarios
from dopslam_ros.study.estimators import KINDS
from dopslam_ros.study.names import FILTERS

pytestmark = pytest.mark.once
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
        assert "--quiet" in capfd.readouterr().out, command


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
    command = [sys.executable, "-m", "dopslam_ros.cli"]
    subprocess.run(command, env=environment, check=True, capture_output=True)
    return [word.strip() for word in out.read_text().split("\n")]


def test_completion(tmp_path: Path) -> None:
    """Commands, options and the names of scenes."""
    assert {"replay", "report", "recover"} <= set(completions("dopslam re", tmp_path))
    assert "--json" in completions("dopslam replay --js", tmp_path)
    assert set(completions("dopslam simulate --scenario ", tmp_path)) >= set(builtin_scenarios())


HEAVY = {"matplotlib", "numba", "numpy", "plotly", "rclpy", "rich", "rosbags", "scipy", "tqdm"}


@pytest.mark.parametrize(
    ("start", "left_out"),
    [
        ("import dopslam_ros.cli as cli; cli._parser()", HEAVY),
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
    stop, seen = Stop(), []
    for item in stop(range(9)):
        if item == 3:
            signal.raise_signal(signal.SIGINT)
        seen.append(item)
    assert seen == [0, 1, 2, 3] and stop.asked and stop.code() == 130
    assert signal.getsignal(signal.SIGINT) is before

    def twice() -> Iterator[int]:
        for item in Stop()(range(9)):
            signal.raise_signal(signal.SIGINT)
            signal.raise_signal(signal.SIGINT)
            yield item

    with pytest.raises(KeyboardInterrupt):
        list(twice())
    assert list(Stop()(range(3))) == [0, 1, 2] and Stop().code() == 0


def test_ctrl_c_keeps_what_was_done(
    tmp_path: Path, simulated: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    """A replay that is stopped writes a whole bag and a result of the steps until then."""
    from dopslam_ros import replay

    filtered = replay.FilterSession.add_measurements

    def interrupted(self: object, stamp: int, measurements: object) -> object:
        if stamp == 2_500_000_000:  # the fourth set
            signal.raise_signal(signal.SIGINT)
        return filtered(self, stamp, measurements)  # type: ignore[arg-type]

    monkeypatch.setattr(replay.FilterSession, "add_measurements", interrupted)
    bag, file = tmp_path / "bag", tmp_path / "result.json"
    assert main(["replay", str(simulated), "--out", str(bag), "--json", str(file)]) == 130
    assert "kept" in capsys.readouterr().err
    content = json.loads(file.read_text("utf-8"))
    assert content["steps"] == 4 and content["stopped"] is True
    reader = BagReader(bag)
    assert reader.damage is None and (bag / "metadata.yaml").is_file()
    assert reader.topics["/" + topics.UE_STATE.name].message_count == 4
