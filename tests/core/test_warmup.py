"""After the warm-up nothing is left to compile."""

from __future__ import annotations

import math
import subprocess
import sys
from typing import Any

import pytest

from dopslam_ros.core.filter import FilterParameters
from dopslam_ros.core.warmup import warm_up_filter

# In a process of its own: other tests call kernels too, and with arrays of other kinds.
RUN = """
import importlib, pkgutil
from dataclasses import replace
import numpy as np
from numba.core.dispatcher import Dispatcher
from dopslam_ros.core import kernels
from dopslam_ros.core.scenario import load_scenario
from dopslam_ros.core.session import BoundsParameters, FilterSession
from dopslam_ros.core.simulator import simulate
from dopslam_ros.core.study import filter_parameters_for
from dopslam_ros.core.warmup import touch_the_rest, warm_up_bounds, warm_up_filter

def known():
    found = {}
    for module in pkgutil.iter_modules(kernels.__path__, kernels.__name__ + "."):
        for name, member in vars(importlib.import_module(module.name)).items():
            if isinstance(member, Dispatcher):
                found[member.py_func.__name__] = len(member.signatures)
    return found

scenario = replace(load_scenario("paper"), clutter_mean=3.0)
parameters = filter_parameters_for(scenario)
touch_the_rest()  # first: its arrays must be of the kinds that the run has
warm_up_filter(parameters)
warm_up_bounds(BoundsParameters())
before = known()
print("twice:", [name for name, count in before.items() if count > 1])
session, asleep = FilterSession(parameters), 0
for snapshot in simulate(scenario, np.random.default_rng(1)):
    control = snapshot.control
    list(session.add_control(snapshot.stamp_ns, control.speed, control.turn_rate))
    for output in session.add_measurements(snapshot.stamp_ns, snapshot.measurements):
        asleep += len(output.state.best.asleep) > 0 and len(output.landmarks.ids) > 0
print("new:", [name for name, count in known().items() if count != before[name]])
print("slept:", asleep > 0)
"""


def test_a_run_compiles_nothing_that_the_warm_up_has_not() -> None:
    done = subprocess.run([sys.executable, "-c", RUN], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == ["twice: []", "new: []", "slept: True"]


@pytest.mark.parametrize(
    "changes",
    [
        {"detection_probability": 0.0},
        {"sp_field_of_view": 0.0},
        {"clutter_mean": 0.0},
        {"measurement_noise_std": (0.1, 0.05, math.nan, 0.05, math.nan, math.nan)},
        {"coupling": "marginal"},
        {"density": "pmbm"},
        {"gamma": 1},
    ],
)
def test_it_works_with_any_parameters(changes: dict[str, Any]) -> None:
    warm_up_filter(FilterParameters(**changes))
