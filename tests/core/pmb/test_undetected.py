"""What is left undetected: the product over all snapshots as the witness."""

from __future__ import annotations

import math

import numpy as np
import pytest

from dopslam_ros.core.linalg.jit import from_python
from dopslam_ros.core.linalg.vec import Vec
from dopslam_ros.core.pmb import FilterParameters
from dopslam_ros.core.pmb import undetected as kernels
from dopslam_ros.core.pmb.density import Undetected
from dopslam_ros.core.pmb.undetected import MOST_VIEWPOINTS, nothing_seen

log_share_left = from_python(kernels.log_share_left)

PARAMETERS = FilterParameters()
FLOOR = 1e-3
SP, VA = 2, 1


def looked_from(
    undetected: Undetected, place: np.ndarray, parameters: FilterParameters
) -> Undetected:
    x, y = place.tolist()
    return kernels.looked_from(undetected, x, y, parameters.constants.sp_field_of_view)


def drive(places: np.ndarray, parameters: FilterParameters = PARAMETERS) -> Undetected:
    undetected = nothing_seen()
    for place in places:
        undetected = looked_from(undetected, place, parameters)
    return undetected


def left(
    undetected: Undetected,
    position: list[float],
    kind: int,
    floor: float = FLOOR,
    parameters: FilterParameters = PARAMETERS,
) -> float:
    constants = parameters.constants._replace(undetected_floor=floor)
    log_share = log_share_left(undetected, Vec(*position), kind, 0.1, constants)
    return math.exp(log_share)


def test_nothing_is_thinned_out_before_the_first_snapshot() -> None:
    assert left(nothing_seen(), [3.0, 4.0, 0.0], SP) == 1.0
    assert left(nothing_seen(), [3.0, 4.0, 0.0], VA) == 1.0


def test_vas_are_in_view_from_everywhere_and_thin_out_down_to_the_floor() -> None:
    undetected = drive(np.array([[0.0, 0.0], [500.0, 0.0]]))
    assert left(undetected, [-900.0, 0.0, 0.0], VA) == pytest.approx(0.01)
    undetected = drive(np.zeros((10, 2)))
    assert left(undetected, [-900.0, 0.0, 0.0], VA) == pytest.approx(FLOOR)


def test_an_sp_thins_out_by_every_snapshot_that_could_have_seen_it() -> None:
    """Steps of 11 m, so that each is a viewpoint: the product over those within 50 m."""
    places = np.stack([np.arange(12) * 11.0, np.zeros(12)], axis=1)
    undetected = drive(places)
    for x in (-60.0, -45.0, 20.0, 100.0, 165.0, 180.0):
        within = int(np.sum(np.hypot(places[:, 0] - x, 10.0) <= 50.0))
        # Those out of reach of the last place are forgotten: it cannot hear what they saw.
        if x > 71.0:
            assert left(undetected, [x, 10.0, 0.0], SP, 1e-30) == pytest.approx(0.1**within)
    assert left(undetected, [165.0, 10.0, 0.0], SP) == pytest.approx(0.1)
    assert left(undetected, [180.0, 10.0, 0.0], SP) == 1.0


def test_a_parked_vehicle_has_one_viewpoint() -> None:
    rng = np.random.default_rng(0)
    undetected = drive(rng.normal(0.0, 0.3, (500, 2)))
    assert len(undetected.viewpoints) == 1 and undetected.viewpoint_looks.tolist() == [500]
    assert left(undetected, [10.0, 0.0, 0.0], SP, 1e-300) == pytest.approx(1e-300)


def test_the_memory_is_bounded_however_long_the_drive() -> None:
    rng = np.random.default_rng(0)
    wandering = np.cumsum(rng.normal(0.0, 6.0, (3000, 2)), axis=0)
    undetected = nothing_seen()
    most = 0
    for place in wandering:
        undetected = looked_from(undetected, place, PARAMETERS)
        most = max(most, len(undetected.viewpoints))
    assert 20 < most <= MOST_VIEWPOINTS + 1
    # What was looked at on the way is gone, but for what is near.
    reach = np.linalg.norm(undetected.viewpoints - wandering[-1], axis=1)
    assert reach.max() < 3.0 * PARAMETERS.sp_field_of_view < np.ptp(wandering, axis=0).max()
    assert undetected.looks == 3000


def test_certain_detection_leaves_the_floor_and_no_infinity() -> None:
    parameters = FilterParameters(detection_probability=1.0)
    undetected = looked_from(nothing_seen(), np.zeros(2), parameters)
    for place, kind, share in (([5.0], SP, FLOOR), ([5.0], VA, FLOOR), ([80.0], SP, 1.0)):
        found = left(undetected, [*place, 0.0, 0.0], kind, parameters=parameters)
        assert found == pytest.approx(share, rel=1e-12)
