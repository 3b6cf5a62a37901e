"""Small problems that other libraries solve too, on the same inputs and with the same answers."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from dopslam_ros.core.association.assignment import k_best_assignments
from dopslam_ros.lab.bench.records import Measured, NotMeasured, milliseconds, times_as_long
from dopslam_ros.offline.metrics import gospa
from dopslam_ros.system.stopping import until_stopped

ROWS, COLUMNS = 8, 9


def assignment(quick: bool) -> Measured:
    """8 paths, 9 landmarks and a way to stay without for each path: 8 x 17."""
    rng = np.random.default_rng(0)
    problems = []
    for _ in range(100 if quick else 2_000):
        cost, idle = rng.uniform(-10.0, 10.0, (ROWS, COLUMNS)), rng.uniform(-10.0, 10.0, ROWS)
        own = np.full((ROWS, ROWS), np.inf)
        np.fill_diagonal(own, idle)
        problems.append((cost, idle, np.hstack([cost, own])))

    def best(cost: Any, idle: Any, _: Any) -> float:
        return float(k_best_assignments(cost, idle, 1).costs[0])

    def ten(cost: Any, idle: Any, _: Any) -> float:
        return float(k_best_assignments(cost, idle, 10).costs[0])

    def scipys(_: Any, __: Any, whole: Any) -> float:
        rows, columns = linear_sum_assignment(whole)
        return float(whole[rows, columns].sum())

    ours, more, theirs = in_turns(problems, best, ten, scipys)
    figures = (
        milliseconds("the best one", ours),
        milliseconds("the 10 best", more),
        milliseconds("SciPy's linear_sum_assignment", theirs),
    )
    ratios = (times_as_long(figures[0], figures[2]), times_as_long(figures[1], figures[2]))
    return Measured(figures, ratios)


def gospa_metric(quick: bool) -> Measured:
    """GOSPA of 8 estimates of 8 landmarks in space."""
    try:
        from stonesoup.metricgenerator.ospametric import GOSPAMetric
        from stonesoup.types.state import State
    except ImportError as error:
        raise NotMeasured("Stone Soup is not installed: pip install stonesoup") from error
    rng = np.random.default_rng(0)
    problems = []
    for _ in range(50 if quick else 1_000):
        truth = rng.uniform(-30.0, 30.0, (8, 3))
        estimate = truth + rng.normal(0.0, 6.0, (8, 3))
        states = [[State(x.reshape(-1, 1)) for x in points] for points in (estimate, truth)]
        problems.append((truth, estimate, *states))
    metric = GOSPAMetric(c=20.0, p=2.0)

    def ours(truth: Any, estimate: Any, *_: Any) -> float:
        return gospa(truth, estimate).distance

    def theirs(_: Any, __: Any, estimate: Any, truth: Any) -> float:
        return float(metric.compute_gospa_metric(estimate, truth)[0].value["distance"])

    mine, others = in_turns(problems, ours, theirs)
    figures = (milliseconds("GOSPA", mine), milliseconds("Stone Soup's", others))
    return Measured(figures, (times_as_long(figures[1], figures[0]),))


def in_turns(problems: list[Any], *solvers: Callable[..., float]) -> list[list[float]]:
    """How long each solver takes for each problem [s].

    Raises:
        RuntimeError: two of them do not agree, so that they have not done the same.
    """
    for solve in solvers:
        solve(*problems[0])
    seconds: list[list[float]] = [[] for _ in solvers]
    for problem in until_stopped(problems):
        answers = []
        for number, solve in enumerate(solvers):
            started = time.perf_counter()
            answers.append(solve(*problem))
            seconds[number].append(time.perf_counter() - started)
        if not all(math.isclose(answers[0], one, rel_tol=1e-6, abs_tol=1e-6) for one in answers):
            raise RuntimeError(f"the solvers disagree: {answers}")
    return seconds
