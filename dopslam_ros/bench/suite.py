"""All benchmarks by their names."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from dopslam_ros.bench import batch, live, pieces, scaling, soak, steps
from dopslam_ros.bench.records import Measured, NotMeasured, Record
from dopslam_ros.study.executors import one_blas_thread


class Benchmark(NamedTuple):
    """Something to measure.

    Attributes:
        title: what is done, in a sentence.
        run: measures it, in little time and roughly where it is told to be quick.
    """

    title: str
    run: Callable[[bool], Measured]


BENCHMARKS = {
    "step": Benchmark("A step on the paper's scene, correlations kept, gamma 10.", steps.joint),
    "marginal": Benchmark(
        "A step on the paper's scene, correlations dropped as in the paper, gamma 10.",
        steps.marginal,
    ),
    "map": Benchmark(
        "A step with 10 landmarks in view and a map that grows out of view.", scaling.map_growth
    ),
    "view": Benchmark(
        "A step with ever more landmarks in view and as many paths in a set.", scaling.view_growth
    ),
    "study": Benchmark(
        "A study of the paper's scene with and without Doppler, with bounds, on all cores.",
        batch.study,
    ),
    "replay": Benchmark(
        "A bag of the paper's scene replayed, MCAP read and written, start-up excluded.",
        batch.replay_of_a_bag,
    ),
    "nodes": Benchmark(
        "The filter node in a process of its own at 100 Hz, all it says subscribed to.",
        live.nodes,
    ),
    "memory": Benchmark("Memory of a filter that never stops.", batch.memory),
    "soak": Benchmark(
        "Two hours of a scene at 10 Hz from a bag, twice: memory, times and results.", soak.soak
    ),
    "ready": Benchmark(
        'The filter node from its start to "ready", first and later starts.', live.ready
    ),
    "bounds": Benchmark(
        "A step of the bounds, with and without Doppler, 8 landmarks.", batch.bounds
    ),
    "gospa": Benchmark("GOSPA of 8 landmarks beside Stone Soup's.", pieces.gospa_metric),
    "assignment": Benchmark(
        "The best associations of 8 paths, as an 8 x 17 problem, beside SciPy's.",
        pieces.assignment,
    ),
}


def measure(name: str, quick: bool) -> Record:
    """Runs a benchmark, with BLAS on one thread; one whose needs are not met says so in a note."""
    title, run = BENCHMARKS[name]
    try:
        with one_blas_thread():
            return Record(name, title, run(quick))
    except NotMeasured as reason:
        return Record(name, title, Measured(notes=(f"not measured: {reason}",)))
