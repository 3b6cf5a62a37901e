"""All benchmarks by their names."""

from __future__ import annotations

from collections.abc import Callable

from dopslam_ros.lab.bench import batch, live, load, pieces, scaling, soak, steps
from dopslam_ros.lab.bench.records import Measured, NotMeasured, Record
from dopslam_ros.lab.bench.titles import TITLES
from dopslam_ros.lab.study.executors import one_blas_thread
from dopslam_ros.system.stopping import Stop

Benchmark = Callable[[bool], Measured]


def here(benchmark: Benchmark) -> Benchmark:
    """One whose compiled functions run in this process: Ctrl-C waits for the end of a step."""

    def stoppable(quick: bool) -> Measured:
        with Stop():
            return benchmark(quick)

    return stoppable


# Each measures in little time and roughly where it is told to be quick.
BENCHMARKS: dict[str, Benchmark] = {
    "step": here(steps.joint),
    "marginal": here(steps.marginal),
    "map": here(scaling.map_growth),
    "view": here(scaling.view_growth),
    "study": batch.study,
    "replay": here(batch.replay_of_a_bag),
    "nodes": live.nodes,
    "recorder": load.recorder,
    "overload": load.overload,
    "memory": batch.memory,
    "soak": soak.soak,
    "ready": live.ready,
    "bounds": here(batch.bounds),
    "gospa": here(pieces.gospa_metric),
    "assignment": here(pieces.assignment),
}


def measure(name: str, quick: bool) -> Record:
    """Runs a benchmark, with BLAS on one thread; one whose needs are not met says so in a note."""
    title = TITLES[name]
    try:
        with one_blas_thread():
            return Record(name, title, BENCHMARKS[name](quick))
    except NotMeasured as reason:
        return Record(name, title, Measured(notes=(f"not measured: {reason}",)))
