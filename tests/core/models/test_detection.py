"""Shared models: noise, detection and clutter; one set of defaults everywhere."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

from dopslam_ros.core.models.detection import detection_probabilities, log_clutter_intensity
from dopslam_ros.core.pmb import FilterParameters
from dopslam_ros.core.settings.bounding import BoundsParameters
from dopslam_ros.core.settings.model import (
    ModelParameters,
    clutter_box,
    with_doppler_std,
)
from dopslam_ros.core.settings.parameters import declarations, shared_values
from dopslam_ros.simulation.scenario import load_scenario

UE = np.array([10.0, 20.0, 0.0])


def test_the_defaults_are_those_of_the_papers_scene() -> None:
    values = shared_values(load_scenario("paper"), ModelParameters)
    for name, value in values.items():
        np.testing.assert_allclose(getattr(ModelParameters(), name), value, err_msg=name)
    assert set(values) == {d.name for d in declarations(ModelParameters)}
    for other in (FilterParameters, BoundsParameters):
        assert shared_values(other(), ModelParameters) == shared_values(
            ModelParameters(), ModelParameters
        )


def test_derived_matrices() -> None:
    model = ModelParameters(
        measurement_noise_std=(0.1, 0.2, math.nan, 0.4, 0.5, 0.6),
        process_noise_std=(0.2, 0.4, 0.01, 0.3),
        process_noise_period=2.0,
        initial_std=(1.0, 2.0, 3.0, 4.0),
    )
    assert model.used_components.tolist() == [True, True, False, True, True, True]
    np.testing.assert_allclose(np.diag(model.noise), [0.01, 0.04, math.nan, 0.16, 0.25, 0.36])
    np.testing.assert_allclose(model.noise_rate, [0.02, 0.08, 5e-5, 0.045])
    np.testing.assert_array_equal(model.initial_covariance, np.diag([1.0, 4.0, 9.0, 16.0]))


def test_only_the_doppler_changes() -> None:
    model = ModelParameters()
    assert with_doppler_std(model, 0.3).measurement_noise_std[:5] == model.measurement_noise_std[:5]
    assert with_doppler_std(model, 0.3).measurement_noise_std[5] == 0.3
    assert with_doppler_std(model, None).used_components.tolist() == [True] * 5 + [False]
    parameters = with_doppler_std(FilterParameters(gamma=3), None)
    assert isinstance(parameters, FilterParameters) and parameters.gamma == 3


def test_detection_ends_sharply_where_positions_are_exact() -> None:
    positions = UE + np.array([[49.9, 0.0, 0.0], [0.0, 50.1, 0.0], [0.0, 30.0, 40.0], [400, 0, 0]])
    model = ModelParameters(detection_probability=0.8)
    chance = detection_probabilities(model, UE, positions, np.array([2, 2, 2, 2]))
    assert chance.tolist() == [0.8, 0.0, 0.8, 0.0]
    chance = detection_probabilities(model, UE, positions, np.array([0, 1, 1, 0]))
    assert chance.tolist() == [0.8] * 4


def test_detection_is_an_expectation_where_they_are_not() -> None:
    rng = np.random.default_rng(0)
    model = ModelParameters()
    distances, std = np.array([30.0, 45.0, 49.0, 50.0, 53.0, 90.0]), 4.0
    positions = UE + np.outer(distances, [1.0, 0.0, 0.0])
    chance = detection_probabilities(model, UE, positions, np.full(6, 2), np.full(6, std))
    drawn = distances + std * rng.standard_normal((100_000, 1))
    np.testing.assert_allclose(chance, 0.9 * (drawn <= 50.0).mean(axis=0), atol=0.006)
    # Without std it is the step again.
    sharp = detection_probabilities(model, UE, positions, np.full(6, 2), np.zeros(6))
    np.testing.assert_allclose(sharp[[0, 1, 2, 4, 5]], [0.9, 0.9, 0.9, 0.0, 0.0])


def test_the_edge_is_a_normal_distribution_far_into_its_tails() -> None:
    distances = np.linspace(1.0, 120.0, 60)
    positions, std = UE + np.outer(distances, [0.6, 0.0, 0.8]), np.linspace(0.5, 6.0, 60)
    chance = detection_probabilities(ModelParameters(), UE, positions, np.full(60, 2), std)
    expected = 0.9 * norm.cdf((50.0 - distances) / std)
    np.testing.assert_allclose(chance, expected, rtol=1e-12, atol=1e-300)
    with pytest.raises(ValueError, match="'distance_std' has the shape"):
        detection_probabilities(ModelParameters(), UE, positions, np.full(60, 2), std[:1])


def test_clutter_integrates_to_its_mean() -> None:
    model = ModelParameters(clutter_mean=3.0)
    box = clutter_box(model)
    volume = np.prod(box[:, 1] - box[:, 0])
    everything = np.ones((1, 6), dtype=bool)
    assert math.exp(log_clutter_intensity(model, everything)[0]) * volume == pytest.approx(3.0)
    # The sister code's number, std over the Doppler too, of its clutter mean of 1.
    sister = replace(model, clutter_mean=1.0, clutter_path_length=(0.0, 400.0))
    expected = 400.0 * math.pi**4 * 4.0 * 50.0
    assert math.exp(-log_clutter_intensity(sister, everything)[0]) == pytest.approx(expected)


def test_clutter_of_fewer_components_is_the_marginal() -> None:
    model = ModelParameters(clutter_mean=3.0)
    measured = np.array([[True, False, False, False, False, True], [False] * 6])
    np.testing.assert_allclose(
        np.exp(log_clutter_intensity(model, measured)), [3.0 / (400.0 * 50.0), 3.0]
    )


def test_no_clutter_is_no_intensity() -> None:
    none = log_clutter_intensity(ModelParameters(clutter_mean=0.0), np.ones((2, 6), dtype=bool))
    assert none.tolist() == [-math.inf, -math.inf]
