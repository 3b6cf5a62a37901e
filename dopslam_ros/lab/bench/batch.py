"""What runs offline: studies, replays, the bounds, and the filter for a very long time."""

from __future__ import annotations

import math
import multiprocessing
import os
import signal
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np

from dopslam_ros.bag import BagReader, BagWriter
from dopslam_ros.core.linalg.arrays import FloatArray
from dopslam_ros.core.session.bounding import BoundsSession, WorldState
from dopslam_ros.core.session.filtering import FilterSession
from dopslam_ros.core.settings.layout import VEHICLE
from dopslam_ros.lab.bench.records import Measured, NotMeasured, Ratio, figure, milliseconds
from dopslam_ros.lab.study.executors import run_local
from dopslam_ros.lab.study.plan import Plan
from dopslam_ros.offline.replay import replay
from dopslam_ros.simulation.matched import bounds_parameters_for, filter_parameters_for
from dopslam_ros.simulation.recording import write_simulation
from dopslam_ros.simulation.scenario import load_scenario
from dopslam_ros.simulation.simulator import all_landmarks, simulate
from dopslam_ros.system.stopping import until_stopped

DOPPLERS = (0.1, None)
# Steps until all memory that the filter will ever need should be in use.
SETTLED = 1_000


def study(quick: bool) -> Measured:
    """A study of the paper's scene with and without Doppler, bounds included, on all cores."""
    scenario = load_scenario("paper")
    plan = Plan(scenario, ("joint",), DOPPLERS, runs=2 if quick else 100, seed=1)
    tasks = list(plan.tasks())
    started = time.perf_counter()
    outcomes = list(run_local(plan, tasks, None))
    wall = time.perf_counter() - started
    failed = [outcome for outcome in outcomes if outcome.part is None]
    if failed:
        raise RuntimeError(f"{failed[0].task} failed: {failed[0].error.splitlines()[-1]}")
    steps = np.concatenate([outcome.part.seconds for outcome in outcomes if outcome.part])
    simulated = len(tasks) * scenario.steps * scenario.period
    return Measured(
        (
            figure(f"{len(tasks)} runs of {scenario.steps} steps", "s", [wall]),
            milliseconds("filter's step in a worker", steps.tolist()),
        ),
        (
            Ratio("time simulated / time taken", simulated / wall),
            Ratio("filter's time in all workers / time taken", float(steps.sum()) / wall),
        ),
    )


def replay_of_a_bag(quick: bool) -> Measured:
    """Ten laps of the paper's scene from an MCAP file through filter and bounds into another."""
    scenario = load_scenario("paper")
    scenario = replace(scenario, controls=scenario.controls * 10)  # what is done once weighs little
    seconds = []
    with TemporaryDirectory() as folder:
        source = Path(folder) / "simulated"
        with BagWriter(source, flush_seconds=None) as writer:
            write_simulation(scenario, 1, writer)
        for number in range(2 if quick else 8):
            started = time.perf_counter()
            with BagWriter(Path(folder) / str(number), flush_seconds=None) as writer:
                replay(BagReader(source), writer=writer)
            seconds.append(time.perf_counter() - started)
    taken = milliseconds(f"{scenario.steps} steps", seconds[1:])  # the first one is the start-up
    real_ms = 1e3 * scenario.steps * scenario.period
    return Measured((taken,), (Ratio("time recorded / time taken", real_ms / taken.median),))


def bounds(quick: bool) -> Measured:
    """The recursion of the bounds, with and without Doppler at once, over 8 landmarks."""
    scenario = load_scenario("paper")
    positions, types = all_landmarks(scenario)
    seconds = []
    for seed in range(2 if quick else 20):
        session = BoundsSession(bounds_parameters_for(scenario))
        for snapshot in until_stopped(simulate(scenario, np.random.default_rng(seed))):
            detected = np.isin(np.arange(len(types)), snapshot.sources)
            world = WorldState(snapshot.state, np.arange(len(types)), types, positions, detected)
            control = snapshot.control
            started = time.perf_counter()
            list(session.add_control(snapshot.stamp_ns, control.speed, control.turn_rate))
            list(session.add_world(snapshot.stamp_ns, world))
            seconds.append(time.perf_counter() - started)
    taken = milliseconds("step", seconds[scenario.steps :])
    real_ms = 1e3 * scenario.period
    return Measured((taken,), (Ratio("time between snapshots / step", real_ms / taken.median),))


def memory(quick: bool) -> Measured:
    """One filter that goes round and round, in a process of its own.

    Raises:
        RuntimeError: a covariance was not positive definite.
    """
    steps = 3_000 if quick else 100_000
    in_a_child(endless, 1, 10)  # compiles, which takes memory that growth could hide in
    found: Endless = in_a_child(endless, SETTLED, steps)
    if not found.smallest > 0.0:
        raise RuntimeError(f"a correlation matrix had the eigenvalue {found.smallest:.3g}")
    growth = (found.after - found.before) / (steps - SETTLED)
    return Measured(
        (
            figure(f"memory after {SETTLED:,} steps", "MB", [found.before / 2**20]),
            figure(f"memory after {steps:,} steps", "MB", [found.after / 2**20]),
            figure("growth per step", "bytes", [growth]),
            figure("smallest eigenvalue of any correlation matrix", "1", [found.smallest]),
            figure("largest asymmetry of any", "1", [found.asymmetry]),
        ),
        (Ratio(f"memory after {steps:,} / after {SETTLED:,} steps", found.after / found.before),),
        (f"vehicle and map after each of {steps:,} steps, eigenvalues by NumPy",),
    )


class Endless(NamedTuple):
    """What became of a filter that ran for long.

    Attributes:
        before: bytes that the process occupied once all had settled.
        after: bytes at the end.
        smallest: eigenvalue of the correlation matrix of vehicle and map after any step.
        asymmetry: largest difference of an element of such a matrix from the one across.
    """

    before: int
    after: int
    smallest: float
    asymmetry: float


def endless(settled: int, steps: int) -> Endless:
    """Filters so many steps of the paper's scene in this process."""
    scenario = load_scenario("paper")
    session = FilterSession(filter_parameters_for(scenario))
    laps = -(-steps // scenario.steps)
    # Without process noise the vehicle stays on its circle, however often it goes round.
    endless = replace(
        scenario, controls=scenario.controls * laps, process_noise_std=(0.0,) * len(VEHICLE)
    )
    before, smallest, asymmetry = 0, math.inf, 0.0
    for snapshot in simulate(endless, np.random.default_rng(1)):
        control = snapshot.control
        list(session.add_control(snapshot.stamp_ns, control.speed, control.turn_rate))
        for output in session.add_measurements(snapshot.stamp_ns, snapshot.measurements):
            eigenvalue, difference = spectrum(output.state.density.covariance)
            smallest, asymmetry = min(smallest, eigenvalue), max(asymmetry, difference)
        if snapshot.step + 1 == settled:
            before = occupied()
        if snapshot.step + 1 == steps:
            break
    if session.problems:
        raise RuntimeError(f"the filter had problems: {dict(session.problems)}")
    return Endless(before, occupied(), smallest, asymmetry)


def spectrum(covariance: FloatArray) -> tuple[float, float]:
    """Smallest eigenvalue and largest asymmetry of the correlations: free of units.

    Args:
        covariance: (n, n); what is no covariance gives an eigenvalue that is not above zero.
    """
    variance = np.diagonal(covariance)
    if not (np.isfinite(covariance).all() and (variance > 0.0).all()):
        return -math.inf, math.inf
    deviations = np.sqrt(np.outer(variance, variance))
    asymmetry = float(np.abs((covariance - covariance.T) / deviations).max())
    return float(np.linalg.eigvalsh(covariance / deviations)[0]), asymmetry


def occupied(process: int | str = "self") -> int:
    """Resident set size of a process, given by its number, in bytes."""
    try:
        pages = int(Path(f"/proc/{process}/statm").read_text("ascii").split()[1])
    except OSError as error:
        raise NotMeasured(f"this system does not tell what a process occupies: {error}") from error
    return pages * os.sysconf("SC_PAGE_SIZE")


def in_a_child(function: Callable[..., Any], *arguments: Any) -> Any:
    """What a function gives in a new process, which ends with this one's patience.

    Raises:
        RuntimeError: it gave nothing.
    """
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    child = context.Process(target=_send, args=(theirs, function, arguments), daemon=True)
    child.start()
    theirs.close()
    try:
        with suppress(EOFError):
            return ours.recv()
        raise RuntimeError(f"the process that computed {function.__name__} died")
    finally:
        child.terminate()
        child.join()


def _send(connection: Any, function: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent, which ends this one
    connection.send(function(*arguments))
