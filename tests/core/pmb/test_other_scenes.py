"""The filter beside the bound, and beside one that is told the association, on other scenes.

How the limits were chosen: each scene was run 320 times with and without Doppler (eight seeds, not
that of this test) and the runs put into groups as large as here. Of all scenes but the street grid
the worst of 288 groups had 1.24 times the bound, a NEES between 3.0 and 5.2, and 1.12 times the
error of the genie; the limits are a little beyond, so that they hold for any seed. Groups scatter
because the steps of a run are correlated: over all runs the error is 1.00 to 1.04 times the bound
and the NEES 4.0 to 4.2 (ideal 4).

The street grid is worse, and for the genie too: lamp posts passed at three metres bend the
densities more than a linearisation can follow; without them the error is at the bound. The worst
of 60 groups (three seeds) had 1.85 times the bound, a NEES of 10.8, and 1.25 times the error of the
genie; over all runs it is 1.2, 6 and less than 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from dopslam_ros.lab.study.plan import Plan
from dopslam_ros.lab.study.results import Collection, Results
from dopslam_ros.lab.study.run import run_task
from dopslam_ros.lab.study.summary import LAST_STEPS, summarise_study
from dopslam_ros.simulation.scenario import load_scenario

SEED = 8_128
# Errors at the end of a run over their bound; the worst of 4080 runs had 4.2.
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


NEAR = Limits(runs=12, to_bound=1.35, nees=5.7, to_genie=1.2)
LIMITS = {
    "straight": NEAR,
    "figure_eight": NEAR,
    "street_grid": Limits(runs=4, to_bound=2.0, nees=12.0, to_genie=1.4),
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
    assert 0.5 < joint["position_to_bound"]["value"] < limits.to_bound
    assert 2.7 < joint["nees_mean"]["value"] < limits.nees
    assert joint["position_rmse"]["value"] < limits.to_genie * genie["position_rmse"]["value"]

    # No run is lost at its end.
    x, y, peb = (
        results.field("joint", doppler, field)[:, -LAST_STEPS:]
        for field in ("error_x", "error_y", "peb")
    )
    at_the_end = np.sqrt((x**2 + y**2).mean(axis=1) / (peb**2).mean(axis=1))
    assert at_the_end.max() < LOST, at_the_end
