"""The filter node in a process of its own: how soon it answers, and how soon it is ready."""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from dopslam_ros.core.settings.parameters import to_mapping
from dopslam_ros.lab.bench.records import (
    Measured,
    NotMeasured,
    Ratio,
    figure,
    milliseconds,
    times_as_long,
)
from dopslam_ros.simulation.matched import filter_parameters_for
from dopslam_ros.simulation.scenario import load_scenario
from dopslam_ros.system.processes import isolated_environment, node_command, running

RATE = 100.0
# What nodes log when they are.
READY = b"ready"
# The least that a node in Python can be.
BARE_NODE = (
    sys.executable,
    "-c",
    "import rclpy; rclpy.init(); node = rclpy.create_node('bare');"
    " node.get_logger().info('ready'); rclpy.spin(node)",
)
PATIENCE = 120.0


class Exchange(NamedTuple):
    """What a driver found.

    Attributes:
        latencies: from a set sent to its answer received [s].
        lost: sets without an answer.
        processor: time of the processor that who answered took for each set [s].
    """

    latencies: list[float]
    lost: int
    processor: float


def nodes(quick: bool) -> Measured:
    """Sets at 100 Hz through the filter node, and through a node that only hands them on."""
    return exchanges(RATE, 5.0 if quick else 60.0)


def exchanges(rate: float, seconds: float) -> Measured:
    """Filter and relay after each other, with the same messages.

    Args:
        rate: sets per second.
        seconds: how long, each.
    """
    check_rclpy()
    settings = to_mapping(filter_parameters_for(load_scenario("paper")))
    with TemporaryDirectory() as name:
        folder = Path(name)
        bare = _exchange("relay", role("relay"), rate, seconds, folder, None)
        counted = folder / "counted.json"
        command = node_command("filter", settings, folder)
        ours = _exchange("filter", command, rate, seconds, folder, counted)
        heard = json.loads(counted.read_text("utf-8"))
    pose = milliseconds("set sent to pose received", ours.latencies)
    handed_on = milliseconds("set sent to set handed on", bare.latencies)
    silent = [topic for topic, count in heard.items() if not count]
    if silent:
        raise RuntimeError(f"the filter said nothing on {', '.join(silent)}")
    notes = [
        f"{rate:g} sets a second for {seconds:g} s, the paper's scene; a listener in a process"
        f" of its own got {sum(heard.values()):,} messages on {len(heard)} topics",
        "the relay is an rclpy node that publishes the bytes it gets",
    ]
    if pose.median > 2e3 / rate:
        notes.append("the filter fell behind: this machine, as busy as it was, is too slow")
    return Measured(
        (
            pose,
            handed_on,
            figure("sets lost by the filter", "sets", [ours.lost]),
            figure("sets lost by the relay", "sets", [bare.lost]),
            figure("a core's time taken by the filter node", "%", [1e2 * rate * ours.processor]),
            figure("a core's time taken by the relay", "%", [1e2 * rate * bare.processor]),
        ),
        (
            times_as_long(pose, handed_on),
            Ratio("the same at the 99th percentile", pose.p99 / handed_on.p99),
        ),
        tuple(notes),
    )


def ready(quick: bool) -> Measured:
    """From the start of the process to the line "ready", with the kernels compiled and not yet."""
    check_rclpy()
    cold, warm, bare = [], [], []
    settings = to_mapping(filter_parameters_for(load_scenario("paper")))
    for _ in range(1 if quick else 5):
        with TemporaryDirectory() as name:
            folder = Path(name)
            command = node_command("filter", settings, folder)
            compiled = {"NUMBA_CACHE_DIR": str(folder / "kernels")}
            cold.append(_seconds_to_ready(command, folder, compiled))
            warm.append(_seconds_to_ready(command, folder, compiled))
            bare.append(_seconds_to_ready(BARE_NODE, folder, {}))
    figures = (
        figure("ready, kernels in the cache", "s", warm),
        figure("ready, kernels to be compiled", "s", cold),
        figure("ready, bare rclpy node", "s", bare),
    )
    return Measured(
        figures, (times_as_long(figures[0], figures[2]), times_as_long(figures[1], figures[0]))
    )


def role(name: str, *arguments: object, of: str = "live_nodes") -> list[str]:
    """What starts one of the processes around a node."""
    command = [sys.executable, "-m", f"dopslam_ros.lab.bench.{of}", name]
    return command + [str(argument) for argument in arguments]


def _exchange(
    of: str,
    command: list[str],
    rate: float,
    seconds: float,
    folder: Path,
    counted: Path | None,
) -> Exchange:
    """A driver's time with who answers; with a listener if it shall count into a file."""
    environment = isolated_environment()
    log, result = folder / f"{of}.log", folder / f"{of}.json"
    with ExitStack() as stack:
        if counted is not None:
            said = folder / "listener.log"
            listening = stack.enter_context(running(role("listener", counted), said, environment))
            wait_for(READY, listening, said)
        answering = stack.enter_context(running(command, log, environment))
        wait_for(READY, answering, log)
        said = folder / "driver.log"
        driver = stack.enter_context(
            running(role("driver", of, rate, seconds, result), said, environment)
        )
        taken = []
        for word in (b"begin", b"end"):
            wait_for(word, driver, said, seconds + PATIENCE)
            check_running(answering, log)
            taken.append(processor_seconds(answering.pid))
        if driver.wait(PATIENCE):
            raise RuntimeError(f"the driver ended: {last_line(said)}")
        content = json.loads(result.read_text("utf-8"))
    before, after = taken
    latencies, lost = content["latencies"], content["lost"]
    return Exchange(latencies, lost, (after - before) / (len(latencies) + lost))


def _seconds_to_ready(command: Sequence[str], folder: Path, variables: Mapping[str, str]) -> float:
    log = folder / "ready.log"
    started = time.perf_counter()
    with running(command, log, {**isolated_environment(), **variables}) as process:
        wait_for(READY, process, log, period=0.005)
        taken = time.perf_counter() - started
    return taken


def wait_for(
    word: bytes,
    process: subprocess.Popen[bytes],
    log: Path,
    patience: float = PATIENCE,
    period: float = 0.02,
    meanwhile: Callable[[], object] = bool,
) -> None:
    """Waits until a process says a word.

    Args:
        word: what it says.
        process: who.
        log: where.
        patience: how long [s].
        period: between two looks [s].
        meanwhile: what to do at each.

    Raises:
        RuntimeError: it ended, or took too long.
    """
    end = time.monotonic() + patience
    while True:
        ended = process.poll() is not None
        if word in log.read_bytes():
            return
        if ended:
            raise RuntimeError(f"a node ended: {last_line(log)}")
        if time.monotonic() > end:
            raise RuntimeError(f"waited {patience:g} s in vain: {last_line(log)}")
        meanwhile()
        time.sleep(period)


def check_running(process: subprocess.Popen[bytes], log: Path) -> None:
    """Raises RuntimeError if a process has ended."""
    if process.poll() is not None:
        raise RuntimeError(f"a node ended: {last_line(log)}")


def processor_seconds(pid: int) -> float:
    """Processor time that a process has taken so far [s]."""
    # After the name in brackets, which may hold anything, come fields 3, 4, ...
    fields = Path(f"/proc/{pid}/stat").read_text("utf-8").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def last_line(log: Path) -> str:
    """What a process said last."""
    lines = log.read_text("utf-8", errors="replace").strip().splitlines()
    return lines[-1] if lines else "nothing was logged"


def check_rclpy() -> None:
    """Raises NotMeasured if it is not there."""
    if importlib.util.find_spec("rclpy") is None:
        raise NotMeasured("rclpy is not there: source ROS 2 Jazzy or use .venv")
