"""The command ``dopslam watch``: what it draws is what was said, live and from a bag."""

from __future__ import annotations

import io
import json
import math
import re
import time
from argparse import Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from rich.console import Console

from dopslam_ros.bag import BagReader, BagWriter, deserialize, message_class, serialize
from dopslam_ros.cli.commands import watch
from dopslam_ros.cli.main import main
from dopslam_ros.cli.terminal.board import Board
from dopslam_ros.cli.terminal.feed import recorded
from dopslam_ros.cli.terminal.frame import frame
from dopslam_ros.messages import topics
from dopslam_ros.messages.diagnostics import make_diagnostics

if TYPE_CHECKING:
    from tests.conftest import LiveRun, Processes


def drawn(board: Board) -> str:
    """A frame as text."""
    console = Console(file=io.StringIO(), width=120)
    console.print(frame(board))
    return console.file.getvalue()  # type: ignore[attr-defined]


def last(bag: Path, topic: topics.Topic, prefix: str = "/") -> Any:
    """The last message of a topic."""
    *_, message = BagReader(bag).messages({prefix + topic.name})
    return deserialize(message.payload, topic.type_name)


def row(text: str, label: str) -> list[float]:
    """The numbers in the line of the table that begins with a label."""
    (line,) = (line for line in text.splitlines() if label in line)
    return [float(number) for number in re.findall(r"[-+]?\d+\.\d+", line)]


def test_the_end_of_a_bag(
    live: LiveRun, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """State, sigma, error, landmarks and health are those of the last messages in the bag."""
    file = tmp_path / "end.json"
    assert main(["watch", str(live.bag), "--once", "--json", str(file)]) == 0
    text, content = capsys.readouterr().out, json.loads(file.read_text("utf-8"))
    state, truth = last(live.bag, topics.UE_STATE), last(live.bag, topics.TRUTH_UE)
    expected = [state.x, math.sqrt(state.covariance[0]), state.x - truth.x]
    vehicle = text.partition("\nlandmarks ")[0]
    assert row(vehicle, "x [m]") == pytest.approx(expected, abs=6e-4)
    degrees = math.degrees(state.heading), math.degrees(math.sqrt(state.covariance[10]))
    assert row(text, "heading [deg]")[:2] == pytest.approx(degrees, abs=6e-4)
    for landmark in last(live.bag, topics.LANDMARKS).landmarks[1:]:
        p = landmark.position
        assert f"{p.x:.1f}" in text and f"{landmark.existence_probability:.2f}" in text
    for node in ("/filter", "/simulator", "/bounds"):
        assert re.search(rf"{node}\b.*\b(OK|WARN)\b", text), text
        assert content["health"][node]["level"] in ("OK", "WARN")
    assert content["state"] == [state.x, state.y, state.heading, state.clock_bias]
    assert content["error"][0] == state.x - truth.x
    found = [(m["id"], m["position"][0]) for m in content["landmarks"]]
    assert found == [(m.id, m.position.x) for m in last(live.bag, topics.LANDMARKS).landmarks]
    assert main(["watch", str(live.bag), "-q", "--json", str(file), "--rate", "1e6"]) == 0
    again = json.loads(file.read_text("utf-8"))
    assert again["state"] == content["state"] and not capsys.readouterr().out


def test_the_frame_goes_with_the_time_of_the_bag(live: LiveRun) -> None:
    """Half way it shows the state of half way, and it takes the time that it should."""
    states = [
        (message.log_time_ns, deserialize(message.payload, message.type_name))
        for message in BagReader(live.bag).messages({"/" + topics.UE_STATE.name})
    ]
    wanted = iter(states)
    _, state = next(wanted)
    began = time.monotonic()
    seen = 0
    for board in recorded(live.bag, "", 2.0):
        shown = board.last.get(topics.UE_STATE.name)
        if shown is not None and shown.header.stamp == state.header.stamp:  # type: ignore[attr-defined]
            seen += 1
            assert f"{state.y:.3f}" in drawn(board)  # type: ignore[attr-defined]
            _, state = next(wanted, (0, state))
    assert seen >= len(states)
    reader = BagReader(live.bag)
    messages = [m.log_time_ns for m in reader.messages(set(Board("/").names))]
    assert time.monotonic() - began >= 0.5e-9 * (messages[-1] - (reader.start_time_ns or 0)) - 0.01


def test_rates_count_messages_in_a_second(live: LiveRun) -> None:
    """Of the last seconds alone; a clock that jumps back begins anew."""
    board = Board("/")
    topic = topics.UE_STATE
    payload = next(iter(BagReader(live.bag).messages({"/" + topic.name}))).payload
    assert math.isnan(board.rate(topic))
    for number in range(11):
        board.take("/" + topic.name, payload, 100.0 + 0.25 * number)
    assert board.rate(topic) == pytest.approx(4.0)
    for number in range(101):
        board.take("/" + topic.name, payload, 103.0 + 0.1 * number)
    assert board.rate(topic) == pytest.approx(10.0)
    board.take("/" + topic.name, payload, 1.0)
    assert math.isnan(board.rate(topic))
    assert "ue_state 10.0/s" not in drawn(board)


def test_bad_health_is_shown(live: LiveRun) -> None:
    """A level with its reason; what cannot be read is counted; another vehicle is left out."""
    board = Board("/car1/")
    for name, level in (("/car1/filter", 2), ("/car2/filter", 1)):
        said = make_diagnostics(message_class, 1, name, level, f"{name} is lost: kidnapped", [])
        board.take("/diagnostics", serialize(said, topics.DIAGNOSTICS.type_name), 0.0)
    board.take("/car1/ue_state", b"\0\1\0\0\7", 0.0)
    text = drawn(board)
    assert "ERROR" in text and "/car1/filter is lost: kidnapped" in text
    assert "car2" not in text and "WARN" not in text
    assert "unreadable: 1" in text and "no state yet" in text


def test_of_several_vehicles_one_must_be_chosen(
    tmp_path: Path, simulated: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The namespaces in the bag are named."""
    bag = tmp_path / "two"
    with BagWriter(bag) as writer:
        for vehicle in ("/car1", "/car2"):
            for message in BagReader(simulated).messages({"/" + topics.TRUTH_UE.name}):
                writer.add_topic(vehicle + "/channel_measurements", "std_msgs/msg/String")
                writer.add_topic(vehicle + message.topic, message.type_name)
                writer.write(vehicle + message.topic, message.payload, message.log_time_ns)
    assert main(["watch", str(bag), "--once"]) == 2
    assert "/car1, /car2 (--namespace)" in capsys.readouterr().err
    # No state of the filter is in it: drawn all the same, but not a success.
    assert main(["watch", str(bag), "--once", "--namespace", "car2"]) == 1
    out = capsys.readouterr().out
    assert "vehicle /car2" in out and "no state yet" in out


def test_a_live_run(processes: Processes, scene: Path) -> None:
    """One frame of a run in a namespace, without a terminal; nobody there is said with a 1."""
    where = ("-r", "__ns:=/car1")
    processes.node("filter", *where)
    processes.node("simulator", *where, scenario=scene, rate=2.0, exit_when_done=False)
    watching = processes.dopslam("watch", "--once", "--namespace", "car1", "--patience", "120")
    watching.popen.wait(120.0)
    assert watching.popen.returncode == 0, watching.stderr
    assert "vehicle /car1" in watching.stdout and "/car1/filter" in watching.stdout
    assert len(row(watching.stdout, "clock bias [m]")) >= 2
    nobody = processes.dopslam("watch", "--once", "--namespace", "car7", "--patience", "0.5")
    assert nobody.wait() == 1 and "no state yet" in nobody.stdout


def test_without_a_terminal_the_last_frame_alone(live: LiveRun) -> None:
    """Played to the end as fast as can be; with a terminal it is drawn anew in between."""
    frames = {}
    for terminal in (False, True):
        console = Console(file=io.StringIO(), force_terminal=terminal, width=120)
        options = Namespace(
            bag=live.bag, namespace="", rate=1e6, once=False, patience=1.0, json=None
        )
        assert watch.run(options, console) == 0
        frames[terminal] = console.file.getvalue()  # type: ignore[attr-defined]
    state = last(live.bag, topics.UE_STATE)
    for text in frames.values():
        assert f"{state.y:.3f}" in text
    assert frames[False].count("vehicle /") == 1
    assert "\x1b[" not in frames[False] and "\x1b[" in frames[True]
