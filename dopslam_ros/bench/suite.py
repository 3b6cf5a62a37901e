"""All benchmarks by their names."""

from __future__ import annotations

from collections.abc import Callable

from dopslam_ros.bench import batch, live, load, pieces, scaling, soak, steps
from dopslam_ros.bench.records import Measured, NotMeasured, Record
from dopslam_ros.bench.titles import TITLES
from dopslam_ros.study.executors import one_blas_thread

# Each measures in little time and roughly where it is told to be quick.
BENCHMARKS: dict[str, Callable[[bool], Measured]] = {
    "step": steps.joint,
    "marginal": steps.marginal,
    "map": scaling.map_growth,
    "view": scaling.view_growth,
    "study": batch.study,
    "replay": batch.replay_of_a_bag,
    "nodes": live.nodes,
    "recorder": load.recorder,
    "overload": load.overload,
    "memory": batch.memory,
    "soak": soak.soak,
    "ready": live.ready,
    "bounds": batch.bounds,
    "gospa": pieces.gospa_metric,
    "assignment": pieces.assignment,
}


def measure(name: str, quick: bool) -> Record:
    """Runs a benchmark, with BLAS on one thread; one whose needs are not met says so in a note."""
    title = TITLES[name]
    try:
        with one_blas_thread():
            return Record(name, title, BENCHMARKS[name](quick))
    except NotMeasured as reason:
        return Record(name, title, Measured(notes=(f"not measured: {reason}",)))
