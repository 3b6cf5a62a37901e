"""Nodes and other programs as processes of their own that end with the one who began them."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import yaml

# Seconds for a process to end before it is killed.
CLOSING_SECONDS = 60.0


def isolated_environment() -> dict[str, str]:
    """The environment with a ROS domain that two runs at once are unlikely to share, local only."""
    return {
        **os.environ,
        "ROS_DOMAIN_ID": str(1 + os.getpid() % 100),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    }


def node_command(name: str, parameters: Mapping[str, object], folder: Path) -> list[str]:
    """What starts a node of this package; its parameters are written into the folder."""
    file = folder / f"{name}.yaml"
    file.write_text(yaml.safe_dump({"/**": {"ros__parameters": dict(parameters)}}), "utf-8")
    module = f"dopslam_ros.nodes.{name}"
    return [sys.executable, "-m", module, "--ros-args", "--params-file", str(file)]


@contextmanager
def running(
    command: Sequence[str], log: Path, environment: Mapping[str, str]
) -> Iterator[subprocess.Popen[bytes]]:
    """A process that is told to stop, and waited for, at the end.

    Args:
        command: what to run.
        log: file for all that it writes.
        environment: all its variables.
    """
    with open(log, "wb") as file:
        process = subprocess.Popen(
            list(command),
            stdout=file,
            stderr=subprocess.STDOUT,
            env=dict(environment),
            start_new_session=True,  # Ctrl-C comes to this process, which ends the others in order
        )
        try:
            yield process
        finally:
            _stop(process)


def ask_to_stop(process: subprocess.Popen[bytes]) -> None:
    """As Ctrl-C would, if it still runs; one that has hardly begun ends at once.

    Not by SIGINT: where this process is a job in the background, it is ignored from the start, and
    a node that has not come to its own handlers yet would go on.
    """
    process.terminate()


def _stop(process: subprocess.Popen[bytes]) -> None:
    ask_to_stop(process)
    try:
        process.wait(CLOSING_SECONDS)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
