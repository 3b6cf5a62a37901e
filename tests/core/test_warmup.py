"""After the warm-up nothing is left to compile."""

from __future__ import annotations

import math
import subprocess
import sys
from dataclasses import replace
from typing import Any

import numba
import numpy as np
import pytest
from numba.core.dispatcher import Dispatcher

from dopslam_ros.core import kernels
from dopslam_ros.core.filter import FilterParameters
from dopslam_ros.core.scenario import load_scenario
from dopslam_ros.core.session import FilterSession
from dopslam_ros.core.simulator import simulate
from dopslam_ros.core.study import filter_parameters_for
from dopslam_ros.core.warmup import warm_up_filter


def all_kernels() -> list[Any]:
    import importlib
    import pkgutil

    found = []
    for module in pkgutil.iter_modules(kernels.__path__, kernels.__name__ + "."):
        members = vars(importlib.import_module(module.name)).values()
        found += [m for m in members if isinstance(m, Dispatcher)]
    return found


def signatures() -> int:
    return sum(len(kernel.signatures) for kernel in all_kernels())


def test_a_run_compiles_nothing_that_the_warm_up_has_not() -> None:
    assert numba.__version__
    scenario = replace(load_scenario("paper"), clutter_mean=3.0)
    parameters = filter_parameters_for(scenario)
    warm_up_filter(parameters)
    before = signatures()
    session = FilterSession(parameters)
    for snapshot in simulate(scenario, np.random.default_rng(1)):
        control = snapshot.control
        list(session.add_control(snapshot.stamp_ns, control.speed, control.turn_rate))
        list(session.add_measurements(snapshot.stamp_ns, snapshot.measurements))
    assert signatures() == before


# In a process of its own: other tests call kernels with arrays of other kinds.
COUNTS = """
import importlib, pkgutil
from numba.core.dispatcher import Dispatcher
from dopslam_ros.core import kernels
from dopslam_ros.core.filter import FilterParameters
from dopslam_ros.core.session import BoundsParameters
from dopslam_ros.core.warmup import compile_the_rest, warm_up_bounds, warm_up_filter
compile_the_rest()  # or the first process would have no use for what the second one makes
warm_up_filter(FilterParameters())
warm_up_bounds(BoundsParameters())
for module in pkgutil.iter_modules(kernels.__path__, kernels.__name__ + "."):
    for member in vars(importlib.import_module(module.name)).values():
        if isinstance(member, Dispatcher) and len(member.signatures) > 1:
            print(member.py_func.__name__, member.signatures)
"""


def test_no_kernel_has_two_signatures() -> None:
    done = subprocess.run(
        [sys.executable, "-c", COUNTS], capture_output=True, text=True, check=True
    )
    assert done.stdout == ""


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
