"""The channel: the paper's incidence-point equations and differences as witnesses."""

from __future__ import annotations

import math

import numpy as np
import pytest

from dopslam_ros.core.linalg.arrays import FloatArray, wrap_angle
from dopslam_ros.core.models.channel import incidence_points, observe, observe_sources, residual
from dopslam_ros.core.settings.layout import AZIMUTHS, DIM, DOPPLER, LandmarkType

BS = np.array([3.0, -5.0, 40.0])
GEOMETRIES = range(60)


def unit(vector: FloatArray) -> FloatArray:
    return np.asarray(vector / np.linalg.norm(vector))


def incidence(ue: FloatArray, position: FloatArray, kind: LandmarkType) -> FloatArray:
    """x_inc: for a VA the point of its wall on the line to the vehicle."""
    if kind == LandmarkType.BS:
        return BS
    if kind == LandmarkType.SP:
        return position
    normal = unit(position - BS)
    share = (0.5 * (position + BS) - ue) @ normal / ((position - ue) @ normal)
    return ue + share * (position - ue)


def printed(
    state: FloatArray, speed: float, position: FloatArray, kind: LandmarkType, height: float
) -> FloatArray:
    """h(x, s) of eqs. (4) to (11), as the paper prints them."""
    ue = np.array([state[0], state[1], height])
    point = incidence(ue, position, kind)
    if kind == LandmarkType.BS:
        length, departure = np.linalg.norm(BS - ue), unit(ue - BS)
    else:
        length = np.linalg.norm(point - ue) + np.linalg.norm(point - BS)
        departure = unit(point - BS)
    arrival = unit(point - ue)
    velocity = speed * np.array([math.cos(state[2]), math.sin(state[2]), 0.0])
    return np.array(
        [
            length + state[3],
            wrap_angle(np.arctan2(arrival[1], arrival[0]) - state[2]),
            math.asin(arrival[2]),
            math.atan2(departure[1], departure[0]),
            math.asin(departure[2]),
            velocity @ arrival,
        ]
    )


def geometry(seed: int) -> tuple[FloatArray, float, FloatArray, LandmarkType, float]:
    """A random vehicle and landmark; VAs whose wall is between them and both antennas."""
    rng = np.random.default_rng(seed)
    kind = LandmarkType(seed % 3)
    while True:
        state = np.array([*rng.uniform(-80.0, 80.0, 2), rng.uniform(-4.0, 4.0), 300.0])
        position = rng.uniform([-250.0, -250.0, -5.0], [250.0, 250.0, 60.0])
        height = rng.uniform(0.0, 3.0)
        ue = np.array([state[0], state[1], height])
        side = (ue - 0.5 * (position + BS)) @ unit(position - BS)
        apart = min(float(np.linalg.norm((position - other)[:2])) for other in (ue, BS))
        apart = min(apart, float(np.linalg.norm((ue - BS)[:2])))
        if apart > 5.0 and (kind != LandmarkType.VA or side < -2.0):
            return state, rng.uniform(-30.0, 30.0), position, kind, height


@pytest.mark.parametrize("seed", GEOMETRIES)
def test_observe_is_the_printed_model(seed: int) -> None:
    state, speed, position, kind, height = geometry(seed)
    paths = observe(state, speed, position[None], np.array([int(kind)]), BS, height)
    difference = residual(paths.mean[0], printed(state, speed, position, kind, height))
    np.testing.assert_allclose(difference, 0.0, atol=1e-9)
    assert paths.facing[0] and not paths.degenerate[0]
    assert np.all(np.abs(paths.mean[0, AZIMUTHS]) <= math.pi)


@pytest.mark.parametrize("seed", GEOMETRIES)
def test_jacobians_against_central_differences_of_the_printed_model(seed: int) -> None:
    state, speed, position, kind, height = geometry(seed)
    paths = observe(state, speed, position[None], np.array([int(kind)]), BS, height)
    step = 1e-4
    for column in range(4):
        offset = step * np.eye(4)[column]
        ahead = printed(state + offset, speed, position, kind, height)
        behind = printed(state - offset, speed, position, kind, height)
        np.testing.assert_allclose(
            paths.ue_jacobian[0, :, column], residual(ahead, behind) / (2.0 * step), atol=2e-7
        )
    for column in range(3):
        offset = step * np.eye(3)[column]
        ahead = printed(state, speed, position + offset, kind, height)
        behind = printed(state, speed, position - offset, kind, height)
        np.testing.assert_allclose(
            paths.landmark_jacobian[0, :, column],
            residual(ahead, behind) / (2.0 * step),
            atol=2e-7,
        )


@pytest.mark.parametrize("side", [-1e-6, 0.0, 1e-6])
@pytest.mark.parametrize("kind", list(LandmarkType))
def test_jacobians_hold_across_the_cut_of_the_azimuth(kind: LandmarkType, side: float) -> None:
    # Straight behind: the azimuth of arrival is pi, give or take; the SP's departure as well.
    position = BS + np.array([-60.0, 0.0, -20.0])
    state = np.array([50.0, BS[1] + side * 100.0, side, 10.0])
    paths = observe(state, 20.0, position[None], np.array([int(kind)]), BS)
    assert abs(abs(paths.mean[0, 1]) - math.pi) < 1e-3
    step = 1e-4
    for column in range(4):
        offset = step * np.eye(4)[column]
        ahead = printed(state + offset, 20.0, position, kind, 0.0)
        behind = printed(state - offset, 20.0, position, kind, 0.0)
        np.testing.assert_allclose(
            paths.ue_jacobian[0, :, column], residual(ahead, behind) / (2.0 * step), atol=1e-6
        )


@pytest.mark.parametrize("seed", GEOMETRIES)
def test_doppler_rows_are_those_of_section_three_c(seed: int) -> None:
    state, speed, position, kind, height = geometry(seed)
    paths = observe(state, speed, position[None], np.array([int(kind)]), BS, height)
    ue = np.array([state[0], state[1], height])
    point = incidence(ue, position, kind)
    q = unit(point - ue)
    velocity = speed * np.array([math.cos(state[2]), math.sin(state[2]), 0.0])
    sideways = speed * np.array([-math.sin(state[2]), math.cos(state[2]), 0.0])
    bent = (velocity - (velocity @ q) * q) / np.linalg.norm(point - ue)
    # The incidence point of a VA moves with the vehicle and with the VA.
    step = 1e-4
    by_ue = np.array(
        [
            (incidence(ue + o, position, kind) - incidence(ue - o, position, kind)) / (2 * step)
            for o in step * np.eye(3)
        ]
    )
    by_landmark = np.array(
        [
            (incidence(ue, position + o, kind) - incidence(ue, position - o, kind)) / (2 * step)
            for o in step * np.eye(3)
        ]
    )
    a = np.array([*((by_ue - np.eye(3)) @ bent)[:2], sideways @ q, 0.0])
    b = by_landmark @ bent
    np.testing.assert_allclose(paths.ue_jacobian[0, DOPPLER], a, atol=1e-7)
    np.testing.assert_allclose(paths.landmark_jacobian[0, DOPPLER], b, atol=1e-7)
    if kind != LandmarkType.VA:  # the point stays where it is, and this is the paper's a-tilde
        np.testing.assert_allclose(paths.ue_jacobian[0, DOPPLER, :2], -bent[:2], atol=1e-12)


def test_doppler_is_positive_when_approaching() -> None:
    ahead = np.array([[50.0, 0.0, 0.0], [-50.0, 0.0, 0.0]])
    paths = observe(np.zeros(4), 10.0, ahead, np.array([2, 2]), BS)
    np.testing.assert_allclose(paths.mean[:, DOPPLER], [10.0, -10.0])


@pytest.mark.parametrize("seed", range(1, 60, 3))
def test_a_virtual_anchor_is_a_detour_through_its_wall(seed: int) -> None:
    state, speed, position, _, height = geometry(seed)
    types = np.array([int(LandmarkType.VA)])
    paths = observe(state, speed, position[None], types, BS, height)
    point = incidence_points(state, position[None], types, BS, height)[0]
    ue = np.array([state[0], state[1], height])
    np.testing.assert_allclose(point, incidence(ue, position, LandmarkType.VA), atol=1e-9)
    # It lies on the wall, and the detour over it is as long as the straight line to the VA.
    assert abs((point - 0.5 * (position + BS)) @ unit(position - BS)) < 1e-9
    detour = np.linalg.norm(point - ue) + np.linalg.norm(point - BS)
    assert paths.mean[0, 0] - state[3] == pytest.approx(detour, abs=1e-9)
    assert detour == pytest.approx(np.linalg.norm(position - ue), abs=1e-9)
    azimuth, elevation = paths.mean[0, 3:5]
    ray = np.array(
        [
            math.cos(elevation) * math.cos(azimuth),
            math.cos(elevation) * math.sin(azimuth),
            math.sin(elevation),
        ]
    )
    np.testing.assert_allclose(np.cross(ray, point - BS), 0.0, atol=1e-6)
    assert ray @ (point - BS) > 0.0


def test_incidence_points_of_bs_and_sp_are_themselves_and_absent_behind_a_wall() -> None:
    positions = np.array([[0.0, 0.0, 0.0], [20.0, 5.0, 8.0], [20.0, BS[1], 40.0]])
    points = incidence_points(np.array([60.0, 0.0, 0.0, 0.0]), positions, np.array([0, 2, 1]), BS)
    np.testing.assert_array_equal(points[0], BS)
    np.testing.assert_array_equal(points[1], positions[1])
    assert np.isnan(points[2]).all()


def test_a_batch_is_its_members() -> None:
    cases = [geometry(seed) for seed in range(12)]
    state, speed, height = cases[0][0], 17.0, 1.5
    positions = np.array([case[2] for case in cases])
    types = np.array([int(case[3]) for case in cases])
    batch = observe(state, speed, positions, types, BS, height)
    for row in range(len(cases)):
        one = observe(state, speed, positions[row : row + 1], types[row : row + 1], BS, height)
        for whole, part in zip(batch, one, strict=True):
            np.testing.assert_allclose(whole[row], part[0], rtol=1e-12, atol=1e-12)


def test_no_landmark_is_no_path() -> None:
    paths = observe(np.zeros(4), 1.0, np.zeros((0, 3)), np.zeros(0, dtype=np.int64), BS)
    assert [len(part) for part in paths] == [0] * 5
    assert paths.ue_jacobian.shape == (0, DIM, 4)


UE = np.array([30.0, 20.0, 0.0])
STATE = np.array([30.0, 20.0, 0.4, 5.0])
SINGULAR = {
    "vehicle under an SP": (LandmarkType.SP, np.array([30.0, 20.0, 10.0])),
    "vehicle under a VA": (LandmarkType.VA, np.array([30.0, 20.0, 100.0])),
    "SP at the vehicle": (LandmarkType.SP, UE),
    "SP at the BS": (LandmarkType.SP, BS),
    "VA at the BS": (LandmarkType.VA, BS),
    "VA at the vehicle": (LandmarkType.VA, UE),
    "SP above the BS": (LandmarkType.SP, BS + np.array([0.0, 0.0, 7.0])),
}


@pytest.mark.parametrize("name", list(SINGULAR))
def test_singular_geometry_is_flagged_and_finite(name: str) -> None:
    kind, position = SINGULAR[name]
    with np.errstate(all="raise"):
        paths = observe(STATE, 20.0, position[None], np.array([int(kind)]), BS)
    assert paths.degenerate[0] and not paths.facing[0]
    assert all(np.isfinite(part).all() for part in paths)
    assert not paths.ue_jacobian.any() and not paths.landmark_jacobian.any()


@pytest.mark.parametrize("height", [0.0, BS[2]])
def test_a_vehicle_under_or_at_the_bs_has_no_direction_to_it(height: float) -> None:
    state = np.array([BS[0], BS[1], 0.4, 5.0])
    positions = np.array([[9.0, 9.0, 9.0], [80.0, 30.0, 5.0]])
    with np.errstate(all="raise"):
        paths = observe(state, 20.0, positions, np.array([0, 2]), BS, height)
    assert paths.degenerate.tolist() == [True, False]
    assert all(np.isfinite(part).all() for part in paths)


def mirror_image(normal: FloatArray, through: FloatArray) -> FloatArray:
    return BS + 2.0 * ((through - BS) @ normal) * normal


@pytest.mark.parametrize("offset", [0.0, 1e-9, 0.5, 30.0])
def test_a_vehicle_on_or_behind_the_wall_sees_no_reflection(offset: float) -> None:
    normal = unit(np.array([1.0, 0.3, 0.0]))
    anchor = mirror_image(normal, UE - offset * normal)
    types = np.array([int(LandmarkType.VA)])
    with np.errstate(all="raise"):
        paths = observe(STATE, 20.0, anchor[None], types, BS)
    assert not paths.facing[0] and not paths.degenerate[0]
    assert all(np.isfinite(part).all() for part in paths)
    assert np.isnan(incidence_points(STATE, anchor[None], types, BS)).all()


def test_a_vehicle_just_before_the_wall_sees_it() -> None:
    normal = unit(np.array([1.0, 0.3, 0.0]))
    anchor = mirror_image(normal, UE + 1e-3 * normal)
    paths = observe(STATE, 20.0, anchor[None], np.array([int(LandmarkType.VA)]), BS)
    assert paths.facing[0]
    expected = printed(STATE, 20.0, anchor, LandmarkType.VA, 0.0)
    np.testing.assert_allclose(residual(paths.mean[0], expected), 0.0, atol=1e-6)


def test_residual_wraps_azimuths_only_and_keeps_nan() -> None:
    measured = np.array([700.0, 3.1, 1.5, -3.1, -1.5, np.nan])
    expected = np.array([300.0, -3.1, -1.5, 3.1, 1.5, 2.0])
    difference = residual(measured, expected)
    near = 6.2 - 2.0 * math.pi
    np.testing.assert_allclose(difference, [400.0, near, 3.0, -near, -3.0, np.nan])


def test_residual_of_every_path_and_source() -> None:
    rng = np.random.default_rng(0)
    measured = rng.uniform(-3.0, 3.0, (6, 5)).T  # not in the order of C
    expected = rng.uniform(-3.0, 3.0, (4, 1, DIM))
    difference = residual(measured, expected)
    assert difference.shape == (4, 5, DIM)
    turns = (measured - expected - difference) / (2.0 * math.pi)
    np.testing.assert_allclose(turns, np.round(turns), atol=1e-12)
    assert set(np.unique(np.round(turns[..., AZIMUTHS]))) == {-1.0, 0.0, 1.0}
    others = [column for column in range(DIM) if column not in AZIMUTHS]
    np.testing.assert_array_equal(turns[..., others], 0.0)
    assert (np.abs(difference[..., AZIMUTHS]) <= math.pi).all()


def test_arrays_of_other_kinds_are_taken_and_compile_nothing_new() -> None:
    rows = np.array([[80, 30, 5], [20, -60, 9], [7, 8, 100]])
    types = np.array([2, 1, 0])
    usual = observe(STATE, 20.0, rows.astype(np.float64), types, BS)
    # Of plain Python, where NUMBA_DISABLE_JIT is set, there are none.
    compiled = len(getattr(observe_sources, "signatures", ()))
    sealed = STATE.copy()
    sealed.setflags(write=False)
    kinds = (np.asfortranarray(rows), types.astype(np.int32), np.array(BS, dtype=np.float32))
    other = observe(sealed, np.int64(20), *kinds, ue_height=0)
    for one, same in zip(usual, other, strict=True):
        np.testing.assert_array_equal(one, same)
    assert len(getattr(observe_sources, "signatures", ())) == compiled


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("state", {"state": np.zeros(3)}),
        ("positions", {"positions": np.zeros((1, 3))}),
        ("positions", {"types": np.array([1])}),
        ("bs", {"bs_position": np.zeros(2)}),
    ],
)
def test_shapes_that_do_not_fit_are_refused(name: str, change: dict[str, FloatArray]) -> None:
    fitting = {
        "state": STATE,
        "positions": np.ones((2, 3)),
        "types": np.array([1, 2]),
        "bs_position": BS,
    }
    with pytest.raises(ValueError, match=f"'{name}' has the shape"):
        observe(speed=20.0, **{**fitting, **change})
