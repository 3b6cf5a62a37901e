"""A scene through the real nodes, each a process of its own, recorded until it ends."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from datetime import datetime
from pathlib import Path

from dopslam_ros.bag import BagReader
from dopslam_ros.core.settings.parameters import to_mapping
from dopslam_ros.messages import topics
from dopslam_ros.simulation.matched import bounds_parameters_for, filter_parameters_for
from dopslam_ros.simulation.scenario import Scenario, load_scenario
from dopslam_ros.system.processes import ask_to_stop, isolated_environment, node_command, running

LISTENERS = ("filter", "bounds", "recorder")
# Seconds for a node to appear, or to do anything, before the demo gives up on it.
PATIENCE = 60.0


class DemoError(RuntimeError):
    """The demo did not come to its end; the message says where to look."""


def run_live(
    scenario: str | Path,
    seed: int,
    rate: float,
    folder: Path,
    progress: Callable[[int], None],
) -> Path:
    """Runs simulator, filter, bounds and recorder as processes of their own until the scene ends.

    They talk in a domain of their own on this machine only.

    Args:
        scenario: name or file of the scene.
        seed: of the run.
        rate: times real time.
        folder: existing folder that gets the bag, and the parameters and logs of the nodes.
        progress: called with the number of snapshots recorded so far.

    Returns:
        The bag.

    Raises:
        DemoError: a node died or the scene did not end.
    """
    bag = folder / "live"
    environment = isolated_environment()
    model = load_scenario(scenario)
    settings = {
        "filter": {**to_mapping(filter_parameters_for(model)), "wait_for_nodes": "recorder"},
        "bounds": {**to_mapping(bounds_parameters_for(model)), "wait_for_nodes": "recorder"},
        "recorder": {"bag": str(bag)},
        "simulator": {
            "scenario": str(scenario),
            "seed": seed,
            "rate": rate,
            "wait_for_nodes": ",".join(LISTENERS),
        },
    }
    with ExitStack() as stack:
        nodes = {
            name: stack.enter_context(
                running(node_command(name, values, folder), folder / f"{name}.log", environment)
            )
            for name, values in settings.items()
        }
        try:
            _follow(nodes, bag, progress)
        finally:
            for process in nodes.values():  # all at once; each is waited for on the way out
                ask_to_stop(process)
    return bag


def _follow(
    nodes: Mapping[str, subprocess.Popen[bytes]], bag: Path, progress: Callable[[int], None]
) -> None:
    """Waits for the simulator to end and the results to be recorded."""
    last_news, seen = time.monotonic(), -1
    while True:
        ended = nodes["simulator"].poll() is not None
        for name, process in nodes.items():
            if process.poll() not in (None, 0) or (name != "simulator" and process.poll() == 0):
                raise DemoError(f"node {name} ended with code {process.returncode}: see {name}.log")
        sent, answered = _recorded(bag)
        progress(answered)
        if ended and answered >= sent > 0:
            return
        if answered != seen:
            last_news, seen = time.monotonic(), answered
        elif time.monotonic() - last_news > PATIENCE:
            raise DemoError(f"nothing was recorded for {PATIENCE:g} s: see the .log files")
        time.sleep(0.2)


def _recorded(bag: Path) -> tuple[int, int]:
    """Measurement sets and bounds of snapshots that are in the bag under way."""
    try:
        found = BagReader(bag).topics
    except Exception:  # the recorder has hardly begun
        return 0, 0

    def count(topic: topics.Topic) -> int:
        info = found.get("/" + topic.name)
        return info.message_count if info else 0

    return count(topics.CHANNEL_MEASUREMENTS), min(count(topics.UE_STATE), count(topics.BOUNDS))


def new_folder(parent: Path, scenario: Scenario) -> Path:
    """A new folder for a run, named after the scene and the time.

    Raises:
        DemoError: it cannot be made.
    """
    name = f"{scenario.name}_{datetime.now():%Y%m%d_%H%M%S}"
    for number in range(1000):
        folder = parent / (name if number == 0 else f"{name}_{number}")
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            continue
        except OSError as error:
            raise DemoError(f"cannot make the folder '{folder}': {error}") from error
        return folder
    raise DemoError(f"'{parent / name}' and 999 more exist: clear them away")
