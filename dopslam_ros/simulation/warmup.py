"""A short run nobody sees, so that the first real set meets code that is compiled and loaded.

The very first time the code must be compiled, which takes the better part of a minute. A second
process takes its share: what the step needs last, and the search for a vehicle that is lost. It
hands over what it has made through the cache on disk.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np

from dopslam_ros.core.linalg.jit import cache_folder
from dopslam_ros.core.models.measurements import MeasurementSet
from dopslam_ros.core.models.motion import Control
from dopslam_ros.core.monitoring.pose_problem import Clock
from dopslam_ros.core.monitoring.pose_search import solutions
from dopslam_ros.core.pmb import FilterParameters, initial_posterior
from dopslam_ros.core.pmb import coordinates_kernels as coordinates
from dopslam_ros.core.pmb import inactive_kernels as inactive
from dopslam_ros.core.pmb.birth import Births
from dopslam_ros.core.pmb.density import Regressions, block_starts
from dopslam_ros.core.pmb.hypotheses import Hypotheses, LocalWeights
from dopslam_ros.core.pmb.likelihood import Likelihoods
from dopslam_ros.core.pmb.newborn import Newborn
from dopslam_ros.core.pmb.observed import prepare
from dopslam_ros.core.pmb.step_kernels import DataAssociation, condition_on, posterior, slam
from dopslam_ros.core.session.bounding import BoundsSession, WorldState
from dopslam_ros.core.session.filtering import FilterSession
from dopslam_ros.core.settings.bounding import BoundsParameters
from dopslam_ros.core.settings.layout import (
    DIM,
    LARGEST_LANDMARK,
    SPACE,
    VEHICLE,
    LandmarkType,
    X,
    Y,
)
from dopslam_ros.core.settings.model import ModelParameters
from dopslam_ros.core.settings.parameters import shared_values
from dopslam_ros.simulation.scenario import Scenario
from dopslam_ros.simulation.simulator import Snapshot, all_landmarks, simulate

STEPS = 4


def warm_up_filter(parameters: FilterParameters) -> None:
    """Runs every part of the filter's step once, and of the search for a vehicle that is lost."""
    with _a_second_process():
        _run(replace(parameters, initial_pose="known"))
    touch_the_rest()
    _run(replace(parameters, initial_pose="unknown"))


def warm_up_bounds(parameters: BoundsParameters) -> None:
    """Runs every part of the bounds' recursion once."""
    session = BoundsSession(parameters)
    positions, types = all_landmarks(_scene(parameters))
    for snapshot in _snapshots(parameters):
        world = WorldState(snapshot.state, np.arange(len(types)), types, positions)
        control = snapshot.control
        list(session.add_control(snapshot.stamp_ns, control.speed, control.turn_rate))
        list(session.add_world(snapshot.stamp_ns, world))


def touch_the_rest() -> None:
    """Calls what the step needs last, or now and then, and the search for a lost vehicle.

    This is what the second process compiles, from the end, while the first begins at the start.
    """
    parameters = FilterParameters()
    state, constants = initial_posterior(parameters), parameters.constants
    density = state.density
    nothing = MeasurementSet(np.zeros((0, DIM)), np.zeros((0, DIM, DIM)))
    observed, association = prepare(nothing, parameters), _nothing_heard()
    updated = condition_on(density, association, association.born.kept, observed, constants)
    posterior(association.hypotheses.weight, updated, constants)
    block_starts(len(density.vehicle), density.component_type)
    inactive.left_behind(density, constants.sp_field_of_view)
    inactive.to_reactivate(np.zeros((0, SPACE)), np.zeros(0), density.ue_mean[[X, Y]], 0.0)
    none, nobody = np.zeros((0, SPACE)), np.zeros((0, SPACE, SPACE))
    regressions = Regressions(np.zeros((0, 1), np.int64), none, nobody, none, nobody, nobody)
    inactive.reactivated(density, regressions)
    inactive.current(density, regressions)
    coordinates.in_space(none, nobody, none, nobody)
    solutions(state, observed, 0.0, Clock(0.0, 1.0), parameters)


@contextmanager
def _a_second_process() -> Iterator[None]:
    """Compiles while this one does, where the step is not compiled yet; ends with it."""
    if not sys.executable or any(cache_folder().rglob(f"*.{slam.__name__}-*.nbi")):
        yield
        return
    command = [sys.executable, "-c", f"import {__name__} as w; w.touch_the_rest()"]
    quiet = subprocess.DEVNULL
    with subprocess.Popen(command, stdin=quiet, stdout=quiet, stderr=quiet) as process:
        try:
            yield
        except BaseException:
            process.kill()
            raise


def _run(parameters: FilterParameters) -> None:
    session = FilterSession(parameters)
    for snapshot in _snapshots(parameters):
        control = snapshot.control
        list(session.add_control(snapshot.stamp_ns, control.speed, control.turn_rate))
        for output in session.add_measurements(snapshot.stamp_ns, snapshot.measurements):
            assert output.landmarks is not None


def _nothing_heard() -> DataAssociation:
    """The associations of a set without paths."""
    none, nobody = np.zeros((1, 0)), np.zeros((1, 0), np.int64)
    return DataAssociation(
        Likelihoods(
            np.zeros((1, DIM, len(VEHICLE))),
            np.zeros((1, DIM, LARGEST_LANDMARK)),
            np.zeros(1),
            np.zeros((1, 0, DIM)),
            none,
        ),
        Births(
            np.zeros((2, 0, 3)),
            np.zeros((2, 0, 3, 3)),
            np.zeros((2, 0, LARGEST_LANDMARK, len(VEHICLE))),
            none,
        ),
        LocalWeights(none, none, np.zeros(1), np.zeros(0)),
        Hypotheses(nobody, nobody, np.ones(1), 0.0),
        Newborn(np.zeros(0), np.zeros(0, np.bool_)),
        True,
    )


def _scene(parameters: ModelParameters) -> Scenario:
    """A wall and a scattering point near the start, whatever the models are."""
    ue = np.array([*np.take(parameters.initial_state, [X, Y]), parameters.ue_height])
    near = np.array([0.5 * min(parameters.sp_field_of_view, 50.0), 0.0, 5.0])
    wall = np.array([90.0, 70.0, 80.0])
    return replace(
        Scenario(**shared_values(parameters, Scenario)),
        landmarks=np.array([2.0 * ue - parameters.bs + wall, ue + near]),
        landmark_types=np.array([int(LandmarkType.VA), int(LandmarkType.SP)]),
        controls=(Control(5.0, 0.1),) * STEPS,
    )


def _snapshots(parameters: ModelParameters) -> list[Snapshot]:
    return list(simulate(_scene(parameters), np.random.default_rng(0)))
