"""Nodes in processes of their own under load: what the recorder keeps, what the filter answers."""

from __future__ import annotations

import json
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from dopslam_ros.bag import BagReader
from dopslam_ros.core.settings.parameters import to_mapping
from dopslam_ros.lab.bench.batch import occupied
from dopslam_ros.lab.bench.live import (
    PATIENCE,
    READY,
    check_rclpy,
    check_running,
    last_line,
    processor_seconds,
    role,
    wait_for,
)
from dopslam_ros.lab.bench.live_nodes import BEGIN, END
from dopslam_ros.lab.bench.records import Measured, Ratio, figure, milliseconds, times_as_long
from dopslam_ros.messages import topics
from dopslam_ros.simulation.matched import filter_parameters_for
from dopslam_ros.simulation.scenario import load_scenario
from dopslam_ros.system.processes import isolated_environment, node_command, running

RECORDED_RATE = 1000.0


def recorder(quick: bool) -> Measured:
    """A thousand sets a second, and as many controls, into a bag."""
    return recorded(RECORDED_RATE, 4.0 if quick else 60.0)


def recorded(rate: float, seconds: float) -> Measured:
    """What a recorder keeps of what is sent.

    Args:
        rate: sets per second; each comes with a control.
        seconds: how long.

    Raises:
        RuntimeError: a process ended, or the bag is damaged.
    """
    check_rclpy()
    with TemporaryDirectory() as name:
        folder = Path(name)
        bag, log, said, result = (folder / n for n in ("bag", "log", "said", "result.json"))
        environment = isolated_environment()
        command = node_command("recorder", {"bag": str(bag)}, folder)
        with running(command, log, environment) as keeping:
            wait_for(READY, keeping, log)
            sender = role("feed", rate, seconds, result, of="load_nodes")
            with running(sender, said, environment) as feeding:
                wait_for(BEGIN.encode(), feeding, said)
                before = processor_seconds(keeping.pid)
                wait_for(END.encode(), feeding, said, seconds + PATIENCE)
                taken = processor_seconds(keeping.pid) - before
                if feeding.wait(PATIENCE):
                    raise RuntimeError(f"the sender ended: {last_line(said)}")
            check_running(keeping, log)
            most = occupied(keeping.pid)
        reader, sent = BagReader(bag), json.loads(result.read_text("utf-8"))
        if reader.damage is not None:
            raise RuntimeError(f"the bag is damaged: {reader.damage}")
        lost = [
            sent["sent"] - reader.topics[f"/{topic.name}"].message_count
            for topic in (topics.CHANNEL_MEASUREMENTS, topics.ODOMETRY_CONTROL)
        ]
    return Measured(
        (
            figure("sets sent in a second", "sets", [sent["sent"] / sent["seconds"]]),
            figure("sets lost", "sets", [lost[0]]),
            figure("controls lost", "controls", [lost[1]]),
            figure("a core's time taken by the recorder", "%", [1e2 * taken / sent["seconds"]]),
            figure("memory of the recorder", "MB", [most / 2**20]),
        ),
        notes=(f"for {seconds:g} s, the sets of the paper's scene",),
    )


def overload(quick: bool) -> Measured:
    """More sets than a filter can answer: how many it does, how soon, and how soon all is well."""
    return overloaded(*(2.0, 5.0) if quick else (10.0, 60.0))


def overloaded(brief: float, seconds: float) -> Measured:
    """A filter node asked what it can do, then ten times as much, then a fifth.

    Args:
        brief: how long the first and the last, each [s].
        seconds: how long the second.

    Raises:
        RuntimeError: a process ended.
    """
    check_rclpy()
    with TemporaryDirectory() as name:
        folder = Path(name)
        log, said, result = (folder / n for n in ("log", "said", "result.json"))
        environment = isolated_environment()
        settings = to_mapping(filter_parameters_for(load_scenario("paper")))
        memory: list[int] = []
        with running(node_command("filter", settings, folder), log, environment) as answering:
            wait_for(READY, answering, log)

            def look() -> None:
                check_running(answering, log)
                memory.append(occupied(answering.pid))

            sender = role("overload", brief, seconds, result, of="load_nodes")
            with running(sender, said, environment) as asking:
                wait_for(BEGIN.encode(), asking, said, 4.0 * brief + PATIENCE)
                wait_for(END.encode(), asking, said, seconds + PATIENCE, meanwhile=look)
                if asking.wait(brief + PATIENCE):
                    raise RuntimeError(f"the sender ended: {last_line(said)}")
        return _overload_figures(json.loads(result.read_text("utf-8")), memory, seconds)


def _overload_figures(found: dict[str, Any], memory: list[int], seconds: float) -> Measured:
    alone = figure("sets answered in a second, as many sent", "sets", [found["capacity"]])
    answered = figure("sets answered in a second under load", "sets", [found["answered"]])
    before, under, after = (
        milliseconds(f"set sent to pose received, {when}", found[key])
        for key, when in (
            ("before", "before"),
            ("under_load", "under load"),
            ("after", "from its end on"),
        )
    )
    return Measured(
        (
            alone,
            figure("sets sent in a second under load", "sets", [found["sent"]]),
            answered,
            before,
            under,
            after,
            milliseconds("until a set is answered as soon as before", [found["recovered"]]),
            figure("sets neither answered nor counted as lost", "sets", [found["unknown"]]),
            figure("memory under load", "MB", [size / 2**20 for size in memory]),
        ),
        (
            Ratio(
                "answered in a second, under load / as many sent", answered.median / alone.median
            ),
            times_as_long(after, before),
            Ratio("memory under load, at its end / at its beginning", memory[-1] / memory[0]),
        ),
        (
            f"{seconds:g} s of load; before and after a fifth of what can be answered is sent",
            "of the sets that wait the oldest are dropped: parameter most_waiting",
        ),
    )
