"""After the warm-up nothing is left to compile."""

from __future__ import annotations

import math
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from dopslam_ros.core.pmb import FilterParameters
from dopslam_ros.simulation import warmup
from dopslam_ros.simulation.warmup import warm_up_filter

# In a process of its own: other tests call kernels too, and with arrays of other kinds.
RUN = """
import importlib, pkgutil
from dataclasses import replace
import numpy as np
from numba.core.dispatcher import Dispatcher
from dopslam_ros import core
from dopslam_ros.core.session.filtering import FilterSession
from dopslam_ros.core.settings.bounding import BoundsParameters
from dopslam_ros.simulation.matched import filter_parameters_for
from dopslam_ros.simulation.scenario import load_scenario
from dopslam_ros.simulation.simulator import simulate
from dopslam_ros.simulation.warmup import touch_the_rest, warm_up_bounds, warm_up_filter

def known():
    found = {}
    for module in pkgutil.walk_packages(core.__path__, core.__name__ + "."):
        for name, member in vars(importlib.import_module(module.name)).items():
            if isinstance(member, Dispatcher) and member.stats.cache_path:  # called from Python
                found[member.py_func.__name__] = len(member.signatures)
    return found

scenario = replace(load_scenario("paper"), clutter_mean=3.0)
parameters = filter_parameters_for(scenario)
touch_the_rest()  # first: its arrays must be of the kinds that the run has
warm_up_filter(parameters)
warm_up_bounds(BoundsParameters())
before = known()
print("twice:", [name for name, count in before.items() if count > 1])
session, inactive = FilterSession(parameters), 0
for snapshot in simulate(scenario, np.random.default_rng(1)):
    control = snapshot.control
    list(session.add_control(snapshot.stamp_ns, control.speed, control.turn_rate))
    for output in session.add_measurements(snapshot.stamp_ns, snapshot.measurements):
        inactive += len(output.state.inactive[0]) > 0 and len(output.landmarks.ids) > 0
print("new:", [name for name, count in known().items() if count != before[name]])
print("slept:", inactive > 0)
"""


def test_a_run_compiles_nothing_that_the_warm_up_has_not() -> None:
    done = subprocess.run([sys.executable, "-c", RUN], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == ["twice: []", "new: []", "slept: True"]


@pytest.fixture
def helper(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """In the place of Python, a program that notes what it is asked to run, and takes its time."""
    program, noted = tmp_path / "python", tmp_path / "noted"
    program.write_text(f'#!/bin/sh\necho "$2" > {noted}\nexec sleep ${{NAP:-0}}\n')
    program.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(program))
    monkeypatch.setattr(warmup, "cache_folder", lambda: tmp_path)
    monkeypatch.setattr(warmup, "_run", lambda parameters: None)
    return noted


def test_where_nothing_is_compiled_a_second_process_takes_its_share(
    helper: Path, tmp_path: Path
) -> None:
    warm_up_filter(FilterParameters())
    assert warmup.touch_the_rest.__name__ in helper.read_text()
    helper.unlink()
    (tmp_path / "step_kernels.slam-7.py311.nbi").touch()
    warm_up_filter(FilterParameters())
    assert not helper.exists()


def test_who_gives_up_does_not_wait_for_the_second_process(
    helper: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def give_up(parameters: FilterParameters) -> None:
        while not helper.exists():
            time.sleep(0.01)
        raise KeyboardInterrupt

    monkeypatch.setenv("NAP", "60")
    monkeypatch.setattr(warmup, "_run", give_up)
    started = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        warm_up_filter(FilterParameters())
    assert time.monotonic() - started < 30.0


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
