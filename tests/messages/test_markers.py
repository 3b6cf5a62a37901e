"""Landmarks as markers: what is drawn is right, and goes when the landmark goes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from made_maps import BS, SP, VA, landmarks
from scipy.stats import chi2

from dopslam_ros.bag import deserialize, message_class, serialize
from dopslam_ros.core.pmb import LandmarkEstimates
from dopslam_ros.messages import topics
from dopslam_ros.messages.common import make_header, stamp_ns
from dopslam_ros.messages.markers import Markers, quaternions

ADD, DELETE = 0, 2


def keys(array: Any, action: int) -> set[tuple[str, int]]:
    """Namespace and id of the markers with an action."""
    found = [(m.ns, m.id) for m in array.markers if m.action == action]
    assert len(set(found)) == len(found)
    return set(found)


def make() -> Markers:
    """Fresh ones."""
    return Markers(message_class, BS)


def said(markers: Markers, estimates: LandmarkEstimates) -> Any:
    """The marker array for some landmarks, after a passage through bytes."""
    type_name = topics.LANDMARK_MARKERS.type_name
    array = markers.of(make_header(message_class, 10**9, "world"), estimates)
    return deserialize(serialize(array, type_name), type_name)


def test_markers_have_a_namespace_per_type() -> None:
    """A body per landmark in the namespace of its type, an ellipsoid beside it, the id as id."""
    array = said(make(), landmarks((3, VA), (7, SP)))
    assert keys(array, ADD) == {
        ("BS", 0),
        ("VA", 3),
        ("VA_ellipsoid", 3),
        ("SP", 7),
        ("SP_ellipsoid", 7),
    }
    assert keys(array, DELETE) == set()
    assert {m.header.frame_id for m in array.markers} == {"world"}
    assert {stamp_ns(m.header) for m in array.markers} == {10**9}
    assert all(m.lifetime.sec == m.lifetime.nanosec == 0 for m in array.markers)
    assert all(min(m.scale.x, m.scale.y, m.scale.z) > 0.0 for m in array.markers)


def test_markers_keep_their_ids_and_go_with_the_landmark() -> None:
    """A landmark that is gone is deleted once; one that stays is only moved."""
    markers = make()
    said(markers, landmarks((3, VA), (7, SP), (9, SP)))
    second = said(markers, landmarks((3, VA), (9, SP), (12, VA)))
    assert {("VA", 3), ("SP", 9), ("VA", 12), ("BS", 0)} <= keys(second, ADD)
    assert keys(second, DELETE) == {("SP", 7), ("SP_ellipsoid", 7)}
    third = said(markers, landmarks((3, VA), (9, SP), (12, VA)))
    assert keys(third, DELETE) == set()
    assert keys(third, ADD) == keys(second, ADD)
    last = said(markers, landmarks())
    assert keys(last, ADD) == {("BS", 0)}
    assert len(keys(last, DELETE)) == 6
    deleted = [m for m in last.markers if m.action == DELETE]
    assert {m.header.frame_id for m in deleted} == {"world"}


def test_a_landmark_that_changes_its_type_changes_its_namespace() -> None:
    """The marker of the old type is deleted, so that it is not shown twice."""
    markers = make()
    said(markers, landmarks((3, VA)))
    array = said(markers, landmarks((3, SP)))
    assert keys(array, ADD) == {("BS", 0), ("SP", 3), ("SP_ellipsoid", 3)}
    assert keys(array, DELETE) == {("VA", 3), ("VA_ellipsoid", 3)}


@pytest.mark.parametrize("seed", range(5))
def test_ellipsoids_hold_95_percent(seed: int) -> None:
    """The ellipsoid is {x : x' P^-1 x <= chi2(0.95, 3)}, in size and in orientation."""
    from scipy.spatial.transform import Rotation

    estimates = landmarks((4, SP), seed=seed)
    (marker,) = [m for m in said(make(), estimates).markers if m.ns == "SP_ellipsoid"]
    q = marker.pose.orientation
    axes = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
    radii = np.array([marker.scale.x, marker.scale.y, marker.scale.z]) / 2.0
    surface = axes @ np.diag(radii**2) @ axes.T
    assert np.allclose(surface, chi2.ppf(0.95, 3) * estimates.covariances[0], rtol=1e-9)
    p = marker.pose.position
    assert np.array_equal([p.x, p.y, p.z], estimates.positions[0])
    samples = np.random.default_rng(seed).multivariate_normal(
        np.zeros(3), estimates.covariances[0], 40_000
    )
    inside = (np.square(samples @ axes / radii).sum(axis=1) <= 1.0).mean()
    assert abs(inside - 0.95) < 0.006


def test_quaternions_are_those_of_scipy() -> None:
    """Any rotations, and the half turns, in which one component is all there is."""
    from scipy.spatial.transform import Rotation

    halves = [np.diag(turn) for turn in ([1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1])]
    some = Rotation.random(200, random_state=1).as_matrix()
    rotations = np.concatenate([halves, some])
    ours, theirs = quaternions(rotations), Rotation.from_matrix(rotations).as_quat()
    assert np.allclose(ours, theirs, rtol=0.0, atol=1e-15)


def test_the_body_fades_with_the_existence() -> None:
    """How sure a landmark is can be seen: its probability is the opacity."""
    array = said(make(), landmarks((3, VA)))
    opacity = {m.ns: m.color.a for m in array.markers}
    assert opacity["BS"] == 1.0 and opacity["VA"] == 0.75


def test_a_degenerate_covariance_is_drawn() -> None:
    """A covariance with a direction without spread gives a flat ellipsoid, not NaN."""
    estimates = landmarks((3, VA))
    estimates.covariances[0] = np.diag([4.0, 1.0, -1e-18])
    (marker,) = [m for m in said(make(), estimates).markers if m.ns == "VA_ellipsoid"]
    sizes = np.array([marker.scale.x, marker.scale.y, marker.scale.z])
    assert np.isfinite(sizes).all() and sizes.min() == 1e-3
