"""Metrics: Stone Soup, worked examples and sampling as witnesses."""

from __future__ import annotations

import math

import numpy as np
import pytest
from stonesoup.metricgenerator.ospametric import GOSPAMetric
from stonesoup.types.state import State

from dopslam_ros.core.linalg.arrays import FloatArray
from dopslam_ros.offline.metrics import gospa, nees, rmse, state_errors


def stone_soup(truth: FloatArray, estimate: FloatArray, c: float, p: float) -> dict[str, float]:
    metric = GOSPAMetric(c=c, p=p)
    result, _ = metric.compute_gospa_metric(
        [State(point.reshape(-1, 1)) for point in estimate],
        [State(point.reshape(-1, 1)) for point in truth],
    )
    return {name: float(value) for name, value in result.value.items()}


@pytest.mark.parametrize("seed", range(40))
def test_gospa_against_stone_soup(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n, m = rng.integers(0, 6, 2)
    n += n == m == 0  # two empty sets are no problem that Stone Soup takes
    truth = rng.uniform(-30.0, 30.0, (n, 3))
    near = truth[: min(n, m)] + rng.normal(0.0, 6.0, (min(n, m), 3))
    estimate = np.vstack([near, rng.uniform(-30.0, 30.0, (m - len(near), 3))])
    c, p = [(20.0, 2.0), (20.0, 1.0), (8.0, 2.0), (15.0, 3.0)][seed % 4]
    ours = gospa(truth, estimate, c, p)
    theirs = stone_soup(truth, estimate, c, p)
    assert ours.distance == pytest.approx(theirs["distance"], abs=1e-9)
    assert ours.localisation == pytest.approx(theirs["localisation"], abs=1e-6)
    assert ours.missed == pytest.approx(theirs["missed"], abs=1e-6)
    assert ours.false == pytest.approx(theirs["false"], abs=1e-6)


@pytest.mark.parametrize("seed", range(20))
def test_gospa_adds_up(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = rng.uniform(-20.0, 20.0, (rng.integers(0, 6), 3))
    estimate = rng.uniform(-20.0, 20.0, (rng.integers(0, 6), 3))
    whole = gospa(truth, estimate)
    assert whole.distance**2 == pytest.approx(whole.localisation + whole.missed + whole.false)
    # As many pairs by either side's count.
    pairs = len(truth) - whole.missed / 200.0
    assert pairs == pytest.approx(len(estimate) - whole.false / 200.0)
    swapped = gospa(estimate, truth)
    assert swapped.distance == pytest.approx(whole.distance)
    assert swapped.missed == pytest.approx(whole.false)


def test_gospa_worked_examples() -> None:
    none = np.zeros((0, 3))
    square = np.array([[0.0, 0.0, 0.0], [50.0, 0.0, 0.0], [0.0, 50.0, 0.0], [50.0, 50.0, 0.0]])
    # Nothing reported of four: the first point of the paper's figure.
    assert gospa(square, none) == pytest.approx((math.sqrt(800.0), 0.0, 800.0, 0.0))
    assert gospa(none, none) == (0.0, 0.0, 0.0, 0.0)
    assert gospa(none, square[:1]) == pytest.approx((math.sqrt(200.0), 0.0, 0.0, 200.0))
    assert gospa(square, square[::-1]).distance == 0.0
    # Two found, 3 m and 4 m off; two missed; one false.
    estimate = np.array([[3.0, 0.0, 0.0], [50.0, 0.0, 4.0], [100.0, 100.0, 0.0]])
    assert gospa(square, estimate) == pytest.approx((math.sqrt(625.0), 25.0, 400.0, 200.0))


def test_gospa_leaves_a_pair_at_the_cut_off_alone() -> None:
    truth = np.zeros((1, 3))
    at, inside = np.array([[20.0, 0.0, 0.0]]), np.array([[19.999, 0.0, 0.0]])
    assert gospa(truth, at) == pytest.approx((20.0, 0.0, 200.0, 200.0))
    assert gospa(truth, inside).missed == 0.0


def test_nees_of_honest_gaussians_is_their_dimension() -> None:
    rng = np.random.default_rng(2)
    root = rng.normal(size=(4, 4))
    covariance = root @ root.T + 0.1 * np.eye(4)
    errors = rng.multivariate_normal(np.zeros(4), covariance, 4000)
    values = np.array([nees(error, covariance) for error in errors])
    # chi-square with 4 degrees of freedom: mean 4, variance 8.
    assert values.mean() == pytest.approx(4.0, abs=4.0 * math.sqrt(8.0 / 4000))
    assert values.var() == pytest.approx(8.0, rel=0.2)
    assert nees(np.array([2.0, 0.0]), np.diag([4.0, 1.0])) == pytest.approx(1.0)


def test_state_errors_wrap_the_heading() -> None:
    estimate = np.array([[1.0, 2.0, 3.1, 4.0], [0.0, 0.0, 0.1, 0.0]])
    truth = np.array([[0.5, 4.0, -3.1, 1.0], [0.0, 0.0, 0.3, 0.0]])
    expected = [[0.5, -2.0, 6.2 - 2 * math.pi, 3.0], [0.0, 0.0, -0.2, 0.0]]
    np.testing.assert_allclose(state_errors(estimate, truth), expected, atol=1e-12)
    np.testing.assert_array_equal(estimate[0], [1.0, 2.0, 3.1, 4.0])


def test_rmse_of_known_errors() -> None:
    errors = np.array([[[3.0, 4.0, math.radians(2.0), -1.0]], [[0.0, 0.0, 0.0, 1.0]]])
    assert rmse(errors) == pytest.approx((math.sqrt(12.5), math.sqrt(2.0), 1.0))
