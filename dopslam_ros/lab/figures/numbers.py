"""The numbers behind the figures of a study, free of any drawing.

Quantities of the vehicle come in threes, in the units of the paper: position [m], heading [deg],
clock bias [m].
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from dopslam_ros.core.linalg.arrays import FloatArray
from dopslam_ros.core.linalg.quantiles import chi_square
from dopslam_ros.core.settings.layout import VEHICLE
from dopslam_ros.core.settings.model import with_doppler_std
from dopslam_ros.lab.published import Published, PublishedBounds, published
from dopslam_ros.lab.study.results import Results
from dopslam_ros.offline.metrics import Rmse
from dopslam_ros.simulation.matched import nominal_bounds
from dopslam_ros.simulation.scenario import Scenario, load_scenario, scenario_content

# The scenes that stand for the paper's simulations, and for its figure of the bounds.
PAPER_SCENE = "paper"
BOUNDS_SCENE = "paper_bounds"
STATE_SIZE = len(VEHICLE)
# Of the vehicle, with their units.
QUANTITIES = {"position": "m", "heading": "deg", "clock bias": "m"}
PROBABILITY = 0.95


class Band(NamedTuple):
    """An interval, or one at each step."""

    low: float
    high: float


class Curve(NamedTuple):
    """A mean over runs at each step.

    Attributes:
        mean: (K,).
        error: (K,) standard error of the mean; 0 where there is one run only.
    """

    mean: FloatArray
    error: FloatArray


def paper_beside(results: Results) -> Published | None:
    """The paper's numbers when the study is of the paper's scene."""
    return published() if _models(results.plan.scenario) == _paper_models() else None


def _models(scenario: Scenario) -> dict[str, Any]:
    """What makes a scene, but for its name, its seed and the noise of the Doppler."""
    content = scenario_content(with_doppler_std(scenario, 1.0))
    return {key: value for key, value in content.items() if key not in ("name", "seed")}


@cache
def _paper_models() -> dict[str, Any]:
    return _models(load_scenario(PAPER_SCENE))


def cases(results: Results) -> list[float | None]:
    """The Doppler noises of a study upwards, and None, without Doppler, last."""
    return sorted(results.plan.dopplers, key=lambda doppler: doppler or math.inf)


def curve(results: Results, name: str, doppler: float | None, field: str) -> Curve | None:
    """The mean of a field over the runs; None when the filter has none, as an association."""
    table = results.field(name, doppler, field)
    if not np.isfinite(table).all():
        return None
    runs, steps = table.shape
    error = table.std(axis=0, ddof=1) / math.sqrt(runs) if runs > 1 else np.zeros(steps)
    return Curve(table.mean(axis=0), error)


def squared_errors(results: Results, name: str, doppler: float | None) -> FloatArray:
    """(runs, K, 3) squared errors of a filter."""
    x, y, heading, clock = (
        np.square(results.field(name, doppler, f"error_{part}"))
        for part in ("x", "y", "heading", "clock")
    )
    return np.stack([x + y, heading * math.degrees(1.0) ** 2, clock], axis=-1)


def squared_bounds(results: Results, name: str, doppler: float | None) -> FloatArray:
    """(runs, K, 3) squared bounds of the same runs."""
    peb, heb, ceb = (
        np.square(results.field(name, doppler, part)) for part in ("peb", "heb", "ceb")
    )
    return np.stack([peb, heb * math.degrees(1.0) ** 2, ceb], axis=-1)


def root_mean(squares: FloatArray) -> Rmse:
    """RMS over runs and steps of (runs, K, 3)."""
    position, heading, clock = np.sqrt(squares.mean(axis=(0, 1))).tolist()
    return Rmse(position, heading, clock)


def over_bound(results: Results, name: str, doppler: float | None) -> FloatArray:
    """(K, 3) RMSE over the runs, divided by the RMS bound, at each step."""
    errors = squared_errors(results, name, doppler).mean(axis=0)
    return np.asarray(np.sqrt(errors / squared_bounds(results, name, doppler).mean(axis=0)))


def mean_square_band(runs: int, dimension: int) -> Band:
    """Where the mean over runs of e' P^-1 e lies with PROBABILITY when P is true.

    Args:
        runs: independent runs.
        dimension: of the Gaussian error e; the sum over runs is chi-square with their product.
    """
    tail = (1.0 - PROBABILITY) / 2.0
    low, high = chi_square([tail, 1.0 - tail], dimension * runs) / runs
    return Band(float(low), float(high))


def bounds_at(sigma_d: float | None) -> PublishedBounds:
    """Our bounds in the scene of the paper's figure, for a Doppler noise [m/s] or without."""
    bound = nominal_bounds(with_doppler_std(load_scenario(BOUNDS_SCENE), sigma_d))
    return PublishedBounds(bound.peb, math.degrees(bound.heb), bound.ceb, float(np.mean(bound.leb)))
