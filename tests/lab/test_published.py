"""The paper's numbers, as its plots have them."""

from __future__ import annotations

import pytest

from dopslam_ros.lab.published import published


def test_numbers_are_those_of_the_plots() -> None:
    """A few of each figure, read from its source by hand."""
    paper = published()
    assert paper.sigmas == (0.05, 0.1, 0.2, 0.3, 0.4, 0.5)
    assert paper.filter_sigma == 0.1
    bounds, without = paper.bounds_at(0.3), paper.bounds_at(None)
    assert bounds is not None and without is not None
    assert bounds == pytest.approx((0.18957, 0.18688, 0.070454, 0.78701), rel=1e-4)
    assert without == pytest.approx((0.19339, 0.24361, 0.074127, 0.84677), rel=1e-4)
    assert paper.rmse_at(0.1) == (0.5314, 0.356, 0.1849)
    assert paper.rmse_at(None) == (0.6194, 0.4021, 0.2458)
    assert paper.correct_weight_at(0.1) == 0.8622
    assert paper.correct_weight_at(None) == 0.6763
    for landmarks, sigma_d, step, value in (
        ("va", 0.1, 2, 16.1613),
        ("va", None, 40, 7.65644),
        ("sp", 0.1, 28, 7.19754),
        ("sp", None, 18, 18.26583),
    ):
        curve = paper.gospa_at(landmarks, sigma_d)  # type: ignore[arg-type]
        assert curve is not None and curve.shape == (40,)
        assert curve[step - 1] == pytest.approx(value, abs=1e-4)


def test_what_the_paper_does_not_have() -> None:
    """The filter was run with one noise only; bounds are there for six."""
    paper = published()
    assert paper.bounds_at(0.07) is None
    assert paper.bounds_at(0.2) is not None
    assert paper.rmse_at(0.2) is None
    assert paper.correct_weight_at(0.2) is None
    assert paper.gospa_at("va", 0.2) is None
