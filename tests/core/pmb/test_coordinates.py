"""Range and direction: round trips, differences, and the density they are made for."""

from __future__ import annotations

import numpy as np
import pytest

from dopslam_ros.core.pmb import coordinates_kernels as kernels
from dopslam_ros.core.pmb.coordinates import frames, jacobians, local_coordinates, positions


@pytest.mark.parametrize("seed", range(5))
def test_round_trip_and_jacobians(seed: int) -> None:
    rng = np.random.default_rng(seed)
    origin, place = rng.normal(0.0, 50.0, (2, 20, 3))
    axes = frames(place - origin + rng.normal(0.0, 3.0, (20, 3)))
    q = local_coordinates(origin, axes, place)
    np.testing.assert_allclose(positions(origin, axes, q), place, atol=1e-9)
    np.testing.assert_allclose(q[:, 0], np.linalg.norm(place - origin, axis=1))
    found = jacobians(axes, q)
    for column, step in enumerate(1e-6 * np.eye(3)):
        difference = positions(origin, axes, q + step) - positions(origin, axes, q - step)
        np.testing.assert_allclose(found[:, :, column], difference / 2e-6, atol=1e-5)
    root = rng.normal(size=(20, 3, 3))
    covariance = root @ np.swapaxes(root, 1, 2)
    position, uncertainty = kernels.in_space(origin, axes, q, covariance)
    np.testing.assert_allclose(position, place, atol=1e-9)
    expected = found @ covariance @ np.swapaxes(found, 1, 2)
    np.testing.assert_allclose(uncertainty, expected, rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(uncertainty, np.swapaxes(uncertainty, 1, 2))


def test_frames_are_rotations_also_straight_up() -> None:
    offset = np.array([[0.0, 0.0, 3.0], [0.0, 0.0, -2.0], [5.0, 0.0, 0.0], [1.0, -2.0, 0.5]])
    axes = frames(offset)
    np.testing.assert_allclose(
        axes @ np.swapaxes(axes, 1, 2), np.tile(np.eye(3), (4, 1, 1)), atol=1e-15
    )
    np.testing.assert_allclose(np.linalg.det(axes), 1.0)
    length = np.linalg.norm(offset, axis=1)
    np.testing.assert_allclose(axes[:, :, 0] * length[:, None], offset, atol=1e-12)
    born = local_coordinates(np.zeros((4, 3)), axes, offset)
    np.testing.assert_allclose(born, np.stack([length, 0 * length, 0 * length], 1), atol=1e-12)


def test_what_is_heard_of_a_young_landmark_is_a_gaussian_here_and_not_in_xyz() -> None:
    """0.1 m of range and 0.05 rad of direction at 200 m: the sphere bends by more than 0.1 m."""
    rng = np.random.default_rng(1)
    axes = frames(np.array([[150.0, 120.0, 40.0]]))
    mean, std = np.array([200.0, 0.0, 0.0]), np.array([0.1, 0.05, 0.05])
    q = mean + std * rng.standard_normal((20_000, 3))
    place = positions(np.zeros((len(q), 3)), np.repeat(axes, len(q), axis=0), q)
    to_position = jacobians(axes, mean[None])[0]
    offset = place - positions(np.zeros((1, 3)), axes, mean[None])
    linear = np.linalg.solve(to_position, offset.T).T / std  # as a filter in x, y, z has it
    assert np.mean(linear[:, 0] ** 2) > 20.0
    assert np.mean(((q - mean) / std)[:, 0] ** 2) == pytest.approx(1.0, rel=0.05)


def test_what_has_no_direction_is_finite() -> None:
    origin = np.array([[1.0, 2.0, 3.0]])
    with np.errstate(all="raise"):
        axes = frames(np.zeros((1, 3)))
        np.testing.assert_allclose(axes[0] @ axes[0].T, np.eye(3), atol=1e-15)
        for place in (origin, origin + axes[:, :, 1], origin - axes[:, :, 0]):
            q = local_coordinates(origin, axes, place)
            assert np.isfinite(q).all()
            assert q[0, 0] == pytest.approx(np.linalg.norm(place - origin))
        assert np.isfinite(jacobians(axes, np.zeros((1, 3)))).all()


def test_frames_and_landmarks_of_different_number_are_refused() -> None:
    axes = np.tile(np.eye(3), (2, 1, 1))
    with pytest.raises(ValueError, match="'axes' has the shape"):
        positions(np.zeros((3, 3)), axes, np.zeros((3, 3)))
    with pytest.raises(ValueError, match="'origin' has the shape"):
        local_coordinates(np.zeros((1, 3)), axes, np.zeros((2, 3)))
    with pytest.raises(ValueError, match="'axes' has the shape"):
        jacobians(axes, np.zeros((1, 3)))
    with pytest.raises(ValueError, match="'displacement' has the shape"):
        frames(np.zeros((2, 2)))
