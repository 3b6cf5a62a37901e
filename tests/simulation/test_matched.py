"""Filter and bounds take what the scene says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dopslam_ros.core.settings.model import with_doppler_std
from dopslam_ros.simulation.matched import (
    bounds_parameters_for,
    filter_parameters_for,
    nominal_bounds,
)
from dopslam_ros.simulation.scenario import load_scenario


def test_filter_and_bounds_take_the_models_of_the_scene() -> None:
    scenario = replace(
        with_doppler_std(load_scenario("paper"), 0.3),
        bs_position=(1.0, 2.0, 3.0),
        clutter_mean=4.0,
    )
    parameters = filter_parameters_for(scenario, coupling="marginal", gamma=4)
    assert parameters.bs_position == (1.0, 2.0, 3.0) and parameters.clutter_mean == 4.0
    assert parameters.measurement_noise_std[5] == 0.3
    assert (parameters.coupling, parameters.gamma) == ("marginal", 4)
    assert bounds_parameters_for(parameters).measurement_noise_std[5] == 0.3


def test_better_sensors_have_better_bounds() -> None:
    scenario = load_scenario("paper_bounds")
    good = replace(scenario, measurement_noise_std=(0.05, *[0.025] * 4, 0.05))
    fine, coarse = nominal_bounds(good), nominal_bounds(scenario)
    assert fine.peb < coarse.peb and fine.heb < coarse.heb and fine.ceb < coarse.ceb
    assert np.all(fine.leb < coarse.leb)
