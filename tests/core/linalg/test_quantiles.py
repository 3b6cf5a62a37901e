"""Quantiles, against SciPy's distributions."""

from __future__ import annotations

import numpy as np
from scipy import stats

from dopslam_ros.core.linalg.quantiles import chi_square, student_t

PROBABILITIES = np.array([1e-9, 0.005, 0.5, 0.95, 0.9999])


def test_chi_square() -> None:
    """For any degrees of freedom; none gives NaN."""
    for freedom in (1, 2, 3.5, 4, 6, 400):
        ours = chi_square(PROBABILITIES, freedom)
        np.testing.assert_allclose(ours, stats.chi2.ppf(PROBABILITIES, freedom), rtol=1e-12)
    assert np.isnan(chi_square(0.99, np.arange(2))).tolist() == [True, False]


def test_student_t() -> None:
    """One number each."""
    for freedom in (1, 5, 200):
        for probability in PROBABILITIES:
            theirs = stats.t.ppf(probability, freedom)
            np.testing.assert_allclose(student_t(probability, freedom), theirs, rtol=1e-9)
