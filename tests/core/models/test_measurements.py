"""Checks of a measurement set: what is refused, with which reason, and what is not."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TypeAlias

import numpy as np
import pytest

from dopslam_ros.core.linalg.arrays import FloatArray
from dopslam_ros.core.models.measurements import (
    MOST_PATHS,
    InvalidMeasurements,
    checked_measurements,
)
from dopslam_ros.core.settings.layout import BS_ID, DIM

Arguments: TypeAlias = tuple[FloatArray, FloatArray]

GOOD = np.array([[380.0, 0.1, 0.2, -0.3, -0.2, 5.0], [500.0, 3.0, -0.1, 2.0, 0.3, -12.0]])


def covariances() -> FloatArray:
    """Two good ones: std from 0.1 m to 1 mrad, correlated."""
    rng = np.random.default_rng(0)
    root = rng.normal(size=(2, DIM, DIM))
    correlation = root @ np.swapaxes(root, 1, 2) + np.eye(DIM)
    std = np.array([0.1, 1e-3, 1e-3, 1e-3, 1e-3, 0.1])
    matrices: FloatArray = correlation * np.outer(std, std)
    return 0.5 * (matrices + np.swapaxes(matrices, 1, 2))


def zeros(count: int = 2) -> FloatArray:
    return np.zeros((count, DIM, DIM))


def test_good_sets_pass_as_they_are() -> None:
    for given in (zeros(), covariances()):
        checked = checked_measurements(GOOD, given)
        np.testing.assert_allclose(checked.values, GOOD, rtol=1e-15)
        np.testing.assert_array_equal(checked.covariances, given)
        assert len(checked) == 2 and np.isfinite(checked.values).all()
        assert checked.base_station.tolist() == [BS_ID, BS_ID]


def test_an_empty_set_passes() -> None:
    assert len(checked_measurements(np.zeros((0, DIM)), zeros(0))) == 0


def test_components_may_be_missing_and_their_covariance_is_not_looked_at() -> None:
    values, given = GOOD.copy(), covariances()
    values[0, [2, 5]] = math.nan
    given[0, [2, 5]] = math.nan
    given[0, :, [2, 5]] = math.nan
    given[0, 5, 5] = -1.0
    checked = checked_measurements(values, given)
    assert np.isfinite(checked.values[0]).tolist() == [True, True, False, True, True, False]


def test_azimuths_are_wrapped_and_the_argument_left_alone() -> None:
    values = GOOD.copy()
    values[0, 1], values[1, 3] = 6.0, -4.0
    checked = checked_measurements(values, zeros())
    assert checked.values[0, 1] == pytest.approx(6.0 - 2 * math.pi)
    assert checked.values[1, 3] == pytest.approx(2 * math.pi - 4.0)
    assert values[0, 1] == 6.0


def bad_value(path: int, component: int, value: float) -> Callable[[], Arguments]:
    def build() -> Arguments:
        values = GOOD.copy()
        values[path, component] = value
        return values, zeros()

    return build


def nothing_measured() -> Arguments:
    values = GOOD.copy()
    values[1] = math.nan
    return values, zeros()


def bad_covariance(change: Callable[[FloatArray], None]) -> Callable[[], Arguments]:
    def build() -> Arguments:
        given = covariances()
        change(given[1])
        return GOOD, given

    return build


def set_entries(*entries: tuple[int, int, float]) -> Callable[[FloatArray], None]:
    def change(matrix: FloatArray) -> None:
        for row, column, value in entries:
            matrix[row, column] = value

    return change


def indefinite(matrix: FloatArray) -> None:
    matrix[0, 1] = matrix[1, 0] = 2.0 * math.sqrt(matrix[0, 0] * matrix[1, 1])


def no_variance(matrix: FloatArray) -> None:
    matrix[3] = matrix[:, 3] = 0.0


def singular(matrix: FloatArray) -> None:
    matrix[:] = np.outer(np.arange(1.0, 7.0), np.arange(1.0, 7.0))


BAD = {
    "infinite delay": (bad_value(1, 0, math.inf), "implausible_value", ["path_length", "inf", "1"]),
    "minus infinity": (bad_value(0, 5, -math.inf), "implausible_value", ["doppler", "-inf"]),
    "huge length": (bad_value(0, 0, 1e9), "implausible_value", ["path_length", "1e+09"]),
    "degrees": (bad_value(0, 1, 90.0), "implausible_value", ["aoa_azimuth", "90"]),
    "elevation": (bad_value(0, 4, 45.0), "implausible_value", ["aod_elevation", "45"]),
    "hertz": (bad_value(1, 5, 2e6), "implausible_value", ["doppler", "2e+06"]),
    "nothing measured": (nothing_measured, "nothing_measured", ["path 1"]),
    "NaN covariance": (
        bad_covariance(set_entries((2, 2, math.nan))),
        "covariance_not_finite",
        ["path 1"],
    ),
    "infinite covariance": (
        bad_covariance(set_entries((0, 3, math.inf), (3, 0, math.inf))),
        "covariance_not_finite",
        ["path 1"],
    ),
    "not symmetric": (
        bad_covariance(set_entries((0, 5, 0.01), (5, 0, -0.01))),
        "covariance_not_symmetric",
        ["path 1"],
    ),
    "negative variance": (
        bad_covariance(set_entries((3, 3, -1e-6))),
        "covariance_not_positive_definite",
        ["path 1"],
    ),
    "zero variance": (
        bad_covariance(no_variance),
        "covariance_not_positive_definite",
        ["path 1"],
    ),
    "correlation of two": (
        bad_covariance(indefinite),
        "covariance_not_positive_definite",
        ["path 1"],
    ),
    "singular": (bad_covariance(singular), "covariance_not_positive_definite", ["path 1"]),
}


@pytest.mark.parametrize("name", list(BAD))
def test_bad_sets_are_refused_with_a_reason(name: str) -> None:
    build, reason, words = BAD[name]
    with pytest.raises(InvalidMeasurements) as caught:
        checked_measurements(*build())
    assert caught.value.reason == reason
    for word in words:
        assert word in str(caught.value)


def test_a_small_skew_of_small_variances_is_seen() -> None:
    given = covariances()
    given[0, 1, 2] = -given[0, 1, 2]  # between two angles, far below the variance of the length
    assert abs(given[0, 1, 2]) > 1e-8
    with pytest.raises(InvalidMeasurements) as caught:
        checked_measurements(GOOD, given)
    assert caught.value.reason == "covariance_not_symmetric"


def test_a_skew_is_seen_with_a_component_missing_too() -> None:
    values, given = GOOD.copy(), covariances()
    values[0, 5] = math.nan
    given[0] *= 1e-3  # a sensor so good that nothing is near the scale of one
    given[0, 1, 2] = -given[0, 1, 2]
    with pytest.raises(InvalidMeasurements) as caught:
        checked_measurements(values, given)
    assert caught.value.reason == "covariance_not_symmetric"


def test_rounding_to_single_precision_is_forgiven() -> None:
    given = covariances().astype(np.float32).astype(np.float64)
    given[0, 1, 0] *= 1.0 + 1e-7
    assert len(checked_measurements(GOOD, given)) == 2


def test_too_many_paths_are_refused() -> None:
    count = MOST_PATHS + 1
    with pytest.raises(InvalidMeasurements) as caught:
        checked_measurements(np.ones((count, DIM)), zeros(count))
    assert caught.value.reason == "too_many_paths" and str(count) in str(caught.value)


def test_a_covariance_of_what_was_not_measured_is_ignored() -> None:
    """Only the part over measured components counts; none there leaves it to the filter."""
    values, given = GOOD.copy(), np.zeros((len(GOOD), 6, 6))
    values[0, 5] = math.nan
    given[0, 5, 5] = 1.0
    assert not checked_measurements(values, given).covariances.any()


@pytest.mark.parametrize("variance", [1e-300, 1e300])
def test_a_covariance_beyond_all_receivers(variance: float) -> None:
    """It would be positive definite, and spoil the arithmetic all the same."""
    given = np.tile(variance * np.eye(6), (len(GOOD), 1, 1))
    with pytest.raises(InvalidMeasurements) as caught:
        checked_measurements(GOOD, given)
    assert caught.value.reason == "covariance_implausible"
