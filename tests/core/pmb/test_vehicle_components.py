"""The vehicle is a list of components: one more that nothing depends on changes no number."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dopslam_ros.core.linalg.arrays import FloatArray
from dopslam_ros.core.models.motion import ControlSpan
from dopslam_ros.core.pmb import initial_posterior, prepare, step
from dopslam_ros.core.settings.filtering import FilterParameters
from dopslam_ros.core.settings.layout import VEHICLE
from dopslam_ros.simulation.matched import filter_parameters_for
from dopslam_ros.simulation.scenario import load_scenario
from dopslam_ros.simulation.simulator import simulate

# Of the component that does nothing: its value, its standard deviation, and how it walks.
VALUE, STD, NOISE = 7.0, 2.0, 0.5


def with_one_more(parameters: FilterParameters) -> FilterParameters:
    """The same filter, its vehicle with a component that no model looks at."""
    return replace(
        parameters,
        initial_state=(*parameters.initial_state, VALUE),
        initial_std=(*parameters.initial_std, STD),
        process_noise_std=(*parameters.process_noise_std, NOISE),
    )


def without_it(matrix: FloatArray) -> FloatArray:
    """A vector or matrix over the joint vector, less the component behind the vehicle's own."""
    for axis in range(matrix.ndim):
        matrix = np.delete(matrix, len(VEHICLE), axis)
    return matrix


@pytest.mark.parametrize("mapping", [True, False])
@pytest.mark.parametrize("coupling", ["joint", "marginal"])
@pytest.mark.parametrize("scene", ["paper", "clutter"])
def test_a_component_that_nothing_depends_on_changes_nothing(
    scene: str, coupling: str, mapping: bool
) -> None:
    scenario = load_scenario(scene)
    plain = filter_parameters_for(scenario, coupling=coupling)
    more = with_one_more(plain)
    state, longer = initial_posterior(plain), initial_posterior(more)
    spans: tuple[ControlSpan, ...] = ()
    for number, snapshot in enumerate(simulate(scenario, np.random.default_rng(3))):
        if number == 20:  # by then there is a map to localise in
            plain, more = replace(plain, mapping=mapping), replace(more, mapping=mapping)
        speed = snapshot.control.speed
        observed = prepare(snapshot.measurements, plain)
        state, _ = step(state, observed, spans, speed, plain)
        longer, _ = step(longer, observed, spans, speed, more)
        spans = (ControlSpan(snapshot.control, scenario.period),)
        ours, theirs = state.density, longer.density
        np.testing.assert_array_equal(without_it(theirs.mean), ours.mean)
        np.testing.assert_array_equal(without_it(theirs.covariance), ours.covariance)
        np.testing.assert_array_equal(theirs.existence, ours.existence)
        np.testing.assert_array_equal(theirs.track_id, ours.track_id)
        np.testing.assert_array_equal(theirs.component_weight, ours.component_weight)
    own, period = len(VEHICLE), number * scenario.period
    np.testing.assert_allclose(longer.density.mean[own], VALUE, rtol=1e-12)
    walked = STD**2 + NOISE**2 / plain.process_noise_period * period
    np.testing.assert_allclose(longer.density.covariance[own, own], walked)
