"""The command ``dopslam``: what it gives, what it says when it cannot, and how it ends."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
import yaml

from dopslam_ros.bag import BagReader, BagWriter
from dopslam_ros.cli.main import COMMANDS, main
from dopslam_ros.core.pmb import FilterParameters
from dopslam_ros.core.settings.parameters import to_mapping
from dopslam_ros.lab.published import published
from dopslam_ros.messages import topics

if TYPE_CHECKING:
    from tests.conftest import LiveRun, Processes

STEPS = 8
TIMES = ("step_ms_p50", "step_ms_p99")
Capture = pytest.CaptureFixture[str]


def strict(path: Path) -> Any:
    """The content of a JSON file that has neither NaN nor Infinity."""

    def refuse(name: str) -> None:
        raise AssertionError(f"{name} is no JSON")

    return json.loads(path.read_text("utf-8"), parse_constant=refuse)


def run(*arguments: object) -> int:
    """The exit code of a command."""
    try:
        return main([str(argument) for argument in arguments])
    except SystemExit as end:  # argparse
        return int(end.code or 0)


def complaint(capsys: Capture) -> str:
    """The one line on standard error."""
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1, lines
    assert lines[0].startswith("dopslam: ")
    return lines[0]


# --- help and errors -----------------------------------------------------------------------------


@pytest.mark.parametrize("command", sorted(COMMANDS))
def test_help_has_an_example(capsys: Capture, command: str) -> None:
    """Each command explains itself, with an example that its own parser takes."""
    assert run(command, "--help") == 0
    text = capsys.readouterr().out
    assert f"usage: dopslam {command}" in text
    example = COMMANDS[command].EXAMPLE
    assert example in text and example.startswith(f"dopslam {command} ")


def test_help_lists_the_commands(capsys: Capture) -> None:
    """`dopslam --help` names every command; each of them has an example."""
    assert run("--help") == 0
    text = capsys.readouterr().out
    for command in COMMANDS:
        assert f"\n    {command}" in text
    assert run() == 2


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["simulate", "--scenario", "papper", "--out", "x"], 2, ["papper", "did you mean 'paper'"]),
        (["bounds", "--scenario", "nowhere.yaml"], 2, ["nowhere.yaml", "cannot be read"]),
        (["study", "--scenario", "{bad}"], 2, ["bad.yaml", "not YAML"]),
        (["study", "--scenario", "{odd}"], 2, ["odd.yaml", "speeed", "did you mean 'speed'"]),
        (["simulate", "--out", "{taken}"], 1, ["taken", "exists already"]),
        (["replay", "{bag}", "--out", "{taken}"], 1, ["taken", "exists already"]),
        (["recover", "{bag}", "{taken}"], 1, ["taken", "exists already"]),
        (["replay", "{bag}", "--param", "gama=3"], 2, ["gama", "did you mean 'gamma'"]),
        (["replay", "{bag}", "--param", "gamma=0"], 2, ["gamma", "= 0", "1 .. 1000"]),
        (["replay", "{bag}", "--param", "gamma"], 2, ["--param gamma", "NAME=VALUE"]),
        (["replay", "{bag}", "--params", "{bad}"], 2, ["bad.yaml", "not YAML"]),
        (["replay", "{bag}", "--params", "{list}"], 2, ["list.yaml", "name: value"]),
        (["replay", "{bag}", "--json", "{tmp}/no/where.json"], 2, ["where.json"]),
        (["study", "--runs", "1", "--param", "coupling=foo"], 2, ["coupling", "foo", "joint"]),
        (["replay", "{tmp}/missing"], 1, ["missing", "no bag"]),
        (["replay", "{tmp}/empty.mcap"], 1, ["empty.mcap"]),
        (["replay", "{tmp}/text.mcap"], 1, ["text.mcap"]),
        (["replay", "{tmp}/folder"], 1, ["folder", "no .mcap file"]),
        (["replay", "{other}"], 1, ["channel_measurements", "/chatter"]),
        (["recover", "{tmp}/text.mcap", "{tmp}/new"], 1, ["text.mcap"]),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else None,
)
def test_what_cannot_be_done(
    tmp_path: Path,
    simulated: Path,
    capsys: Capture,
    arguments: list[str],
    code: int,
    words: list[str],
) -> None:
    """One line that names what is wrong, the right exit code, and nothing left behind."""
    places = {name: tmp_path / f"{name}.yaml" for name in ("bad", "odd", "list")}
    places["bad"].write_text("a: [1, 2\nb: }", "utf-8")
    places["odd"].write_text("controls: [{steps: 3, speeed: 1.0, turn_rate: 0.0}]", "utf-8")
    places["list"].write_text("[1, 2]", "utf-8")
    places |= {"tmp": tmp_path, "bag": simulated, "taken": tmp_path / "taken"}
    for name in ("taken", "folder"):
        (tmp_path / name).mkdir()
    (tmp_path / "empty.mcap").touch()
    (tmp_path / "text.mcap").write_text("This is no bag. " * 100, "utf-8")
    places["other"] = tmp_path / "other"
    with BagWriter(places["other"]) as writer:
        writer.add_topic("/chatter", "std_msgs/msg/String")
    before = sorted(tmp_path.rglob("*"))
    assert run(*(argument.format(**places) for argument in arguments)) == code
    line = complaint(capsys)
    for word in words:
        assert word in line, line
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(
    "arguments",
    [
        ["study", "--runs", "0"],
        ["study", "--runs", "many"],
        ["study", "--doppler", "0.1", "-0.1"],
        ["study", "--doppler", "0.1", "no"],
        ["bounds", "--sigma-d", "-0.1"],
        ["bounds", "--sigma-d", "nan"],
        ["demo", "--rate", "0"],
        ["simulate", "--out", "x", "--seed", "-3"],
        ["replay"],
        ["dance"],
    ],
    ids=" ".join,
)
def test_wrong_usage(capsys: Capture, arguments: list[str]) -> None:
    """What the parser refuses ends with 2 and names the argument that it is about."""
    assert run(*arguments) == 2
    last = capsys.readouterr().err.strip().splitlines()[-1]
    assert "error:" in last
    assert arguments[-1].lstrip("-") in last or "required" in last or "invalid choice" in last


def test_an_error_as_a_process(processes: Processes) -> None:
    """As users see it: one line, exit code 2, no traceback."""
    process = processes.dopslam("simulate", "--scenario", "papper", "--out", "x")
    assert process.wait() == 2
    (line,) = process.stderr.strip().splitlines()
    assert "did you mean 'paper'" in line


# --- simulate ------------------------------------------------------------------------------------


def test_simulate_twice(tmp_path: Path, scene: Path, capsys: Capture) -> None:
    """One seed gives one file, byte for byte; another seed gives another."""
    for name, seed in (("a", 3), ("b", 3), ("c", 4)):
        out = tmp_path / name / "bag"
        assert run("simulate", "--scenario", scene, "--seed", seed, "--out", out) == 0
    a, b, c = ((tmp_path / name / "bag" / "bag_0.mcap").read_bytes() for name in "abc")
    assert a == b != c
    assert f"{STEPS} snapshots of scene 'short', seed 3" in capsys.readouterr().out
    texts = [(tmp_path / name / "bag" / "metadata.yaml").read_bytes() for name in "ab"]
    assert texts[0] == texts[1]


def test_simulated_as_another_process(processes: Processes, simulated: Path, scene: Path) -> None:
    """The bytes do not depend on the process that makes them."""
    out = processes.folder / "simulated"
    process = processes.dopslam("simulate", "--scenario", scene, "--seed", 5, "--out", out)
    assert process.wait() == 0, process.stderr
    ours, theirs = (folder / "simulated_0.mcap" for folder in (out, simulated))
    assert ours.read_bytes() == theirs.read_bytes()


# --- bounds --------------------------------------------------------------------------------------


def test_bounds_are_the_papers(tmp_path: Path, capsys: Capture) -> None:
    """All 28 published numbers within 10 %, in the form that the contract says."""
    assert run("bounds", "--json", tmp_path / "b.json") == 0
    content = strict(tmp_path / "b.json")
    assert set(content) == {"rows"}
    rows = content["rows"]
    keys = ["sigma_d", "peb", "heb_deg", "ceb", "leb_mean"]
    assert all(list(row) == keys for row in rows)
    assert [row["sigma_d"] for row in rows] == [0.05, 0.1, 0.2, 0.3, 0.4, 0.5, None]
    ratios = []
    for row in rows:
        theirs = published().bounds_at(row["sigma_d"])
        assert theirs is not None
        ratios += [row[key] / number for key, number in zip(keys[1:], theirs, strict=True)]
    assert len(ratios) == 28
    assert max(abs(ratio - 1.0) for ratio in ratios) < 0.1
    table = capsys.readouterr().out
    assert table.count("(") >= 28 and "without" in table


def test_bounds_of_another_noise(tmp_path: Path, scene: Path) -> None:
    """Only the noises asked for, and without Doppler last; less noise is a lower bound."""
    file = tmp_path / "b.json"
    assert run("bounds", "--scenario", scene, "--sigma-d", 0.07, 0.9, "--json", file) == 0
    rows = strict(file)["rows"]
    assert [row["sigma_d"] for row in rows] == [0.07, 0.9, None]
    assert rows[0]["peb"] < rows[1]["peb"] <= rows[2]["peb"]
    # Some scattering points were never in sight: their bound is infinite, which JSON has not.
    assert [row["leb_mean"] for row in rows] == [None] * 3


# --- replay --------------------------------------------------------------------------------------


def test_replay_json(tmp_path: Path, live: LiveRun, capsys: Capture) -> None:
    """The errors, GOSPA of each step, and step times, as the contract names them."""
    file = tmp_path / "r.json"
    assert run("replay", live.bag, "--json", file, "--out", tmp_path / "again") == 0
    result = strict(file)
    for key in ("position_rmse", "heading_rmse_deg", "clock_bias_rmse", *TIMES):
        assert 0.0 < result[key] < 100.0, key
    assert result["step_ms_p50"] <= result["step_ms_p99"]
    assert result["steps"] == STEPS
    for key in ("gospa_va", "gospa_sp"):
        assert len(result[key]) == STEPS
        assert all(0.0 <= value < 60.0 for value in result[key])
    assert result["problems"] == {} and "damage" not in result
    out = capsys.readouterr().out
    assert f"{result['position_rmse']:.4f}" in out
    assert BagReader(tmp_path / "again").topics["/ue_state"].message_count == STEPS


def test_replay_json_twice(tmp_path: Path, simulated: Path) -> None:
    """But for the times, the numbers are the same each time."""
    results = []
    for name in ("a.json", "b.json"):
        assert run("replay", simulated, "--json", tmp_path / name) == 0
        results.append({k: v for k, v in strict(tmp_path / name).items() if k not in TIMES})
    assert results[0] == results[1]


def test_replay_without_truth(tmp_path: Path, simulated: Path) -> None:
    """A bag from a car has no truth: no errors are told, and the bounds are at the estimate."""
    with BagWriter(tmp_path / "bag") as writer:
        wanted = {"/channel_measurements", "/odometry_control"}
        for message in BagReader(simulated).messages(wanted):
            writer.add_topic(message.topic, message.type_name)
            writer.write(message.topic, message.payload, message.log_time_ns)
    assert run("replay", tmp_path / "bag", "--json", tmp_path / "r.json") == 0
    result = strict(tmp_path / "r.json")
    assert result["steps"] == STEPS
    assert set(TIMES) <= set(result)
    words = ("rmse", "gospa", "nees", "weight")
    assert not [key for key in result if any(word in key for word in words)]
    assert 0.1 < result["bound_position_rms"] < 1.0
    assert result["problems"] == {}


def test_replay_with_settings(tmp_path: Path, simulated: Path) -> None:
    """--param and a ROS parameter file change the filter in the same way."""
    file = tmp_path / "filter.yaml"
    file.write_text(yaml.safe_dump({"/**": {"ros__parameters": {"gamma": 1}}}), "utf-8")
    ways = (["--param", "gamma=1"], ["--params", file], ["--param", "gamma=10"], [])
    numbers = []
    for number, way in enumerate(ways):
        out = tmp_path / f"{number}.json"
        assert run("replay", simulated, *way, "--json", out) == 0
        numbers.append(strict(out)["position_rmse"])
    assert numbers[0] == numbers[1] != numbers[2] == numbers[3]


def test_replay_of_a_cut_bag(tmp_path: Path, cut_bag: Path, capsys: Capture) -> None:
    """What is readable is filtered; text and JSON say what is missing; that is no failure."""
    assert run("replay", cut_bag, "--json", tmp_path / "r.json") == 0
    result = strict(tmp_path / "r.json")
    sets = BagReader(cut_bag).topics["/channel_measurements"].message_count
    assert 0 < result["steps"] == sets < STEPS
    assert "cut.mcap" in result["damage"] and "dopslam recover" in result["damage"]
    assert f"damaged bag: {result['damage']}" in capsys.readouterr().out


def test_recover(
    tmp_path: Path, cut_bag: Path, capsys: Capture, bag_payloads: Callable[..., list[bytes]]
) -> None:
    """What is readable of a damaged bag becomes a sound bag; the old one stays as it is."""
    before = cut_bag.read_bytes()
    assert run("recover", cut_bag, tmp_path / "whole") == 0
    assert cut_bag.read_bytes() == before
    reader, damaged = BagReader(tmp_path / "whole"), BagReader(cut_bag)
    assert reader.damage is None
    assert [m.payload for m in reader.messages()] == [m.payload for m in damaged.messages()]
    out = capsys.readouterr().out
    assert f"{reader.message_count} messages" in out and "missing" in out
    assert run("replay", tmp_path / "whole", "--json", tmp_path / "w.json") == 0
    assert "damage" not in strict(tmp_path / "w.json")
    assert bag_payloads(tmp_path / "whole", topics.CHANNEL_MEASUREMENTS)


def test_recover_finds_a_name(tmp_path: Path, cut_bag: Path, capsys: Capture) -> None:
    """Without a name for the new bag: one beside the old that nothing has, however often."""
    for name in ("cut_recovered", "cut_recovered_1", "cut_recovered_2"):
        assert run("recover", cut_bag) == 0
        assert str(cut_bag.with_name(name)) in capsys.readouterr().out
        assert BagReader(cut_bag.with_name(name)).damage is None


def test_replay_of_a_bag_with_no_messages(tmp_path: Path, capsys: Capture) -> None:
    """A recording that was stopped before the first set: nothing to tell, and nothing breaks."""
    with BagWriter(tmp_path / "bag") as writer:
        writer.add_topic("/channel_measurements", topics.CHANNEL_MEASUREMENTS.type_name)
    code = run("replay", tmp_path / "bag", "--json", tmp_path / "r.json")
    captured = capsys.readouterr()
    assert code == 0, captured.err
    assert strict(tmp_path / "r.json")["steps"] == 0


# --- parameters ----------------------------------------------------------------------------------


@pytest.mark.parametrize("node", ["simulator", "filter", "bounds", "recorder", "player"])
def test_parameters_are_a_file_for_ros(capsys: Capture, node: str) -> None:
    """`dopslam parameters` writes the file that a node takes, a comment with each parameter."""
    assert run("parameters", node) == 0
    text = capsys.readouterr().out
    values = yaml.safe_load(text)["/**"]["ros__parameters"]
    assert values
    assert text.count("\n    # ") == len(values)
    if node == "filter":
        expected = to_mapping(FilterParameters())
        assert {name: values[name] for name in expected} == expected
        assert all(math.isfinite(v) for v in values.values() if isinstance(v, float))
