"""Small linear algebra: numpy as the witness."""

from __future__ import annotations

import numpy as np
import pytest

from dopslam_ros.core.linalg import small as small_kernels
from dopslam_ros.core.linalg.jit import from_python

backward = from_python(small_kernels.backward)
cholesky = from_python(small_kernels.cholesky)
forward = from_python(small_kernels.forward)
forward_columns = from_python(small_kernels.forward_columns)
log_determinant = from_python(small_kernels.log_determinant)
solve_bordered = from_python(small_kernels.solve_bordered)


@pytest.mark.parametrize("n", range(1, 9))
def test_factor_and_solves_are_those_of_numpy(n: int) -> None:
    rng = np.random.default_rng(n)
    root = rng.normal(size=(n, n))
    a = root @ root.T + 0.1 * np.eye(n)
    expected = np.linalg.cholesky(a)
    lower = a.copy()
    assert cholesky(lower, n)
    np.testing.assert_allclose(np.tril(lower), expected, atol=1e-12)
    assert log_determinant(lower, n) == pytest.approx(np.linalg.slogdet(a)[1])
    b = rng.normal(size=n)
    x = b.copy()
    forward(lower, x, n)
    np.testing.assert_allclose(expected @ x, b, atol=1e-10)
    backward(lower, x, n)
    np.testing.assert_allclose(a @ x, b, atol=1e-10)
    bordered = np.zeros((n + 1, n + 1))
    bordered[:n, :n], bordered[n, :n] = lower, b
    assert solve_bordered(bordered, n) == pytest.approx(b @ np.linalg.solve(a, b))
    np.testing.assert_allclose(a @ bordered[n, :n], b, atol=1e-10)
    columns = rng.normal(size=(n, 4))
    y = columns.copy()
    forward_columns(lower, y, n)
    np.testing.assert_allclose(expected @ y, columns, atol=1e-10)


@pytest.mark.parametrize("bad", [-1.0, 0.0, np.nan])
def test_what_is_not_positive_definite_is_told(bad: float) -> None:
    a = np.eye(3)
    a[1, 1] = bad
    assert not cholesky(a, 3)
