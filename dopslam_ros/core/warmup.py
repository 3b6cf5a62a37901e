"""A short run nobody sees, so that the first real set meets code that is compiled and loaded."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dopslam_ros.core.channel import LandmarkType
from dopslam_ros.core.filter import FilterParameters
from dopslam_ros.core.model import ModelParameters
from dopslam_ros.core.motion import Control
from dopslam_ros.core.parameters import shared_values
from dopslam_ros.core.scenario import Scenario
from dopslam_ros.core.session import BoundsParameters, BoundsSession, FilterSession, WorldState
from dopslam_ros.core.simulator import Snapshot, all_landmarks, simulate

STEPS = 4


def warm_up_filter(parameters: FilterParameters) -> None:
    """Runs every part of the filter's step once, and of the search for a vehicle that is lost."""
    for pose in ("known", "unknown"):
        session = FilterSession(replace(parameters, initial_pose=pose))
        for snapshot in _snapshots(parameters):
            control = snapshot.control
            list(session.add_control(snapshot.stamp_ns, control.speed, control.turn_rate))
            for output in session.add_measurements(snapshot.stamp_ns, snapshot.measurements):
                assert output.landmarks is not None


def warm_up_bounds(parameters: BoundsParameters) -> None:
    """Runs every part of the bounds' recursion once."""
    session = BoundsSession(parameters)
    positions, types = all_landmarks(_scene(parameters))
    for snapshot in _snapshots(parameters):
        world = WorldState(snapshot.state, np.arange(len(types)), types, positions)
        control = snapshot.control
        list(session.add_control(snapshot.stamp_ns, control.speed, control.turn_rate))
        list(session.add_world(snapshot.stamp_ns, world))


def _scene(parameters: ModelParameters) -> Scenario:
    """A wall and a scattering point near the start, whatever the models are."""
    ue = np.append(parameters.initial_state[:2], parameters.ue_height)
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
