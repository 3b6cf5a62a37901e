"""Filter and bounds that know the models of a scenario."""

from __future__ import annotations

import numpy as np

from dopslam_ros.core.pcrb.bounds import Bounds
from dopslam_ros.core.pmb import FilterParameters
from dopslam_ros.core.session.bounding import BoundsOutput, BoundsSession, WorldState
from dopslam_ros.core.settings.bounding import BoundsParameters
from dopslam_ros.core.settings.parameters import shared_values
from dopslam_ros.simulation.scenario import Scenario
from dopslam_ros.simulation.simulator import all_landmarks, nominal_trajectory, visible


def filter_parameters_for(scenario: Scenario, **settings: object) -> FilterParameters:
    """The filter that knows the scenario's models, with settings of its own."""
    return FilterParameters(**{**shared_values(scenario, FilterParameters), **settings})


def bounds_parameters_for(model: object) -> BoundsParameters:
    """Bounds with the models of a scenario or of a filter."""
    return BoundsParameters(**shared_values(model, BoundsParameters))


def nominal_bounds(scenario: Scenario) -> Bounds:
    """Bounds at the last step along the path without process noise, detections in expectation."""
    bounding = BoundsSession(bounds_parameters_for(scenario))
    positions, types = all_landmarks(scenario)
    outputs: list[BoundsOutput] = []
    for step, state in enumerate(nominal_trajectory(scenario)):
        stamp, control = scenario.stamp_ns(step), scenario.controls[step]
        chance = np.where(visible(scenario, state, step), scenario.detection_probability, 0.0)
        world = WorldState(state, np.arange(len(types)), types, positions, chance)
        outputs += bounding.add_control(stamp, control.speed, control.turn_rate)
        outputs += bounding.add_world(stamp, world)
    return outputs[-1].with_doppler
