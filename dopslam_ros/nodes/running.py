"""Runs a node as a process: until it is finished or told to stop."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Sequence

import rclpy
from rclpy.exceptions import NameValidationException, ParameterException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.signals import SignalHandlerOptions

from dopslam_ros.nodes.errors import StartError
from dopslam_ros.nodes.node import DopslamNode

RCLError = rclpy_implementation.RCLError


def serve(node_type: Callable[[], DopslamNode]) -> None:
    """Entry point of an executable."""
    raise SystemExit(run(node_type))


def run(create: Callable[[], DopslamNode], arguments: Sequence[str] | None = None) -> int:
    """Runs a node until it is finished or told to stop; returns the exit code.

    Own signal handlers only set a flag, so that Ctrl-C meets the node between two callbacks and
    everything is closed in order. Nothing leaves this machine unless the environment says so.
    """
    stay_on_this_machine()
    try:
        rclpy.init(
            args=list(arguments) if arguments is not None else sys.argv,
            signal_handler_options=SignalHandlerOptions.NO,
        )
        return _spin(create)
    except (StartError, ParameterException, NameValidationException, RCLError) as error:
        print("error:", " ".join(str(error).split()), file=sys.stderr)
        return 2
    finally:
        rclpy.try_shutdown()


def _spin(create: Callable[[], DopslamNode]) -> int:
    stop = False
    executor = SingleThreadedExecutor()

    def ask_to_stop(*_: object) -> None:
        nonlocal stop
        stop = True
        executor.wake()

    # SIGINT even where it is ignored, as in the background: a launch file stops its nodes with it.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, ask_to_stop)
    node: DopslamNode | None = None
    try:
        node = create()
        executor.add_node(node)
        while not stop and not node.finished():
            executor.spin_once(timeout_sec=0.2)
    except ExternalShutdownException:
        pass
    finally:
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)
        if node is not None:
            node.close()
            executor.remove_node(node)
            node.destroy_node()
        executor.shutdown()
    return 0


def stay_on_this_machine() -> None:
    """Nobody outside is found, nor finds us, unless the environment says how far to look."""
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
