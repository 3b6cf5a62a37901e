"""The filter beside the bound, and beside one that is told the association, on other scenes.

How the limits were chosen: each scene was run 120 times (seeds 3, 11 and 2024) and the runs put
into groups as large as here. The worst group of all scenes but the street grid had 1.39 times the
bound, a NEES between 2.6 and 6.0, and 1.11 times the error of the genie; the limits are a tenth
beyond. Groups scatter that much because the steps of a run are correlated: over all runs the
error is 0.98 to 1.05 times the bound and the NEES 3.9 to 4.3 (ideal 4).

The street grid is worse, the genie as well: lamp posts passed at three metres bend the densities
more than a linearisation can follow. Without them the error is at the bound. Its worst group had
1.9 times the bound, a NEES of 12, and 1.28 times the error of the genie; over all runs 1.2, 6 and
0.9.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from dopslam_ros.core.scenario import load_scenario
from dopslam_ros.study.plan import Plan
from dopslam_ros.study.results import Collection, Results
from dopslam_ros.study.run import run_task
from dopslam_ros.study.summary import LAST_STEPS, summarise_study

SEED = 40_417
# Errors at the end of a run over their bound; the worst of 1680 runs had 4.2.
LOST = 6.0


@dataclass(frozen=True)
class Limits:
    """For the average of a group of runs.

    Attributes:
        runs: in the group.
        to_bound: largest position error over its bound.
        nees: largest NEES.
        to_genie: largest position error over that of the genie, on the same runs.
    """

    runs: int
    to_bound: float
    nees: float
    to_genie: float


NEAR = Limits(runs=5, to_bound=1.55, nees=6.6, to_genie=1.22)
LIMITS = {
    "straight": NEAR,
    "figure_eight": NEAR,
    "street_grid": Limits(runs=3, to_bound=2.1, nees=13.5, to_genie=1.4),
    "blocked": NEAR,
    "clutter": NEAR,
    "misdetections": NEAR,
    "far": NEAR,
}


def study(name: str, doppler: float | None, runs: int) -> Results:
    plan = Plan(load_scenario(name), ("joint", "genie"), (doppler,), runs, SEED)
    collection = Collection(plan, None)
    for task in plan.tasks():
        collection.add(task, run_task(plan, task))
    return collection.results()


@pytest.mark.parametrize("doppler", [0.1, None], ids=["with_doppler", "without_doppler"])
@pytest.mark.parametrize("name", list(LIMITS))
def test_the_error_is_near_the_bound(name: str, doppler: float | None) -> None:
    limits = LIMITS[name]
    results = study(name, doppler, limits.runs)
    joint, genie = summarise_study(results)["rows"]
    # Well below the bound is as suspicious: a filter that peeks at the truth would be there.
    assert 0.6 < joint["position_to_bound"]["value"] < limits.to_bound
    assert 2.3 < joint["nees_mean"]["value"] < limits.nees
    assert joint["position_rmse"]["value"] < limits.to_genie * genie["position_rmse"]["value"]

    # No run is lost at its end.
    x, y, peb = (
        results.field("joint", doppler, field)[:, -LAST_STEPS:]
        for field in ("error_x", "error_y", "peb")
    )
    at_the_end = np.sqrt((x**2 + y**2).mean(axis=1) / (peb**2).mean(axis=1))
    assert at_the_end.max() < LOST, at_the_end
