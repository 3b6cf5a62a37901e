"""Whether something saved is a density at all: what comes from a file must not be trusted."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import Any

import numpy as np

from dopslam_ros.core.linalg.arrays import FloatArray, IntArray
from dopslam_ros.core.pmb.density import Density
from dopslam_ros.core.pmb.inactive import SMALLEST_CELL
from dopslam_ros.core.pmb.inactive_grid import InactiveGrid, InactiveLandmarks
from dopslam_ros.core.pmb.posterior import all_ids
from dopslam_ros.core.session.checkpoint import (
    BEFORE_ALL,
    MAP,
    SNAPSHOT,
    Checkpoint,
    CheckpointError,
)
from dopslam_ros.core.settings.layout import SPACE, UNKNOWN_TYPES

# Nothing that is estimated is farther away [m], in any unit.
LARGEST = 1e9
# Probabilities and axes may be off by rounding.
ROUNDING = 1e-6
# Smallest eigenvalue of a correlation matrix: below zero only by rounding.
LEAST_EIGENVALUE = -1e-8
LATEST_NS = 2**63 - 1


def check_checkpoint(saved: Checkpoint) -> None:
    """Looks at everything that the filter will rely on.

    Raises:
        CheckpointError: something is not finite, no probability, no covariance, or does not fit.
    """
    _need(saved.kind in (MAP, SNAPSHOT), f"the kind is '{saved.kind}'")
    _need(BEFORE_ALL <= saved.stamp_ns <= LATEST_NS, f"the stamp is {saved.stamp_ns}")
    stamps = [stamp for stamp, _ in saved.controls]
    _need(all(a < b for a, b in itertools.pairwise(stamps)), "the controls are not in order")
    _need(all(stamp >= 0 for stamp in stamps), "a control is before all time")
    numbers = [value for _, control in saved.controls for value in control]
    numbers += [value for span in saved.owed for value in (*span.control, *span.drift)]
    durations = [value for _, t, drift in saved.owed for value in (t, *drift)]
    _numbers("controls", np.array(numbers + durations, np.float64))
    _need(
        all(t >= 0.0 for t in durations),
        "motion is owed for a negative time or with a negative variance",
    )
    weight = saved.posterior.weight
    _probabilities("weight", weight)
    _need(weight.shape == (len(saved.posterior.densities),), "weights are no vector")
    _need(abs(weight.sum() - 1.0) < ROUNDING, "weights do not sum to 1")
    for density, inactive in zip(saved.posterior.densities, saved.posterior.inactive, strict=True):
        check_density(density)
        _check_inactive(inactive, saved.parameters)
        _check_ids(density, inactive)
    if saved.kind == MAP:
        best = saved.posterior.density
        vehicle = best.ue_mean.any() or best.covariance[: best.start[0]].any()
        _need(len(weight) == 1 and not vehicle, "a map has no vehicle")
    if saved.known is not None:
        fits = saved.kind == SNAPSHOT and saved.known.kind == MAP
        _need(fits and saved.known.known is None, "a map is where none can be")
        check_checkpoint(saved.known)


def check_density(density: Density) -> None:
    """The same for one density."""
    components, tracks = len(density.component_track), len(density.track_id)
    _array("component_type", density.component_type, (components,), whole=True)
    # Before all else: the sizes of the blocks follow from the types.
    _need(bool(np.isin(density.component_type, UNKNOWN_TYPES).all()), "component_type is unknown")
    shapes: dict[str, tuple[int, ...]] = {
        "mean": (int(density.start[-1]),),
        "covariance": (int(density.start[-1]), int(density.start[-1])),
        "origin": (components, SPACE),
        "axes": (components, SPACE, SPACE),
        "component_track": (components,),
        "component_weight": (components,),
        "track_id": (tracks,),
        "existence": (tracks,),
    }
    for name, shape in shapes.items():
        _array(name, getattr(density, name), shape, whole=name in _WHOLE)
    owner = density.component_track
    steps = np.diff(owner, prepend=-1, append=tracks)
    _need(bool(np.isin(steps, (0, 1)).all()) and steps[-1] == 1, "component_track has gaps")
    _probabilities("existence", density.existence)
    _probabilities("component_weight", density.component_weight)
    of_track = np.bincount(owner, density.component_weight, minlength=tracks)
    _need(bool((abs(of_track - 1.0) < ROUNDING).all()), "types do not sum to 1")
    _frames(density.axes)
    _covariance("covariance", density.covariance)
    _check_undetected(density)


def _check_ids(density: Density, inactive: InactiveGrid) -> None:
    ids, next_id = all_ids(density, inactive), density.next_id
    _need(len(np.unique(ids)) == len(ids), "two landmarks have the same id")
    _need(not len(ids) or 1 <= ids.min() <= ids.max() < next_id, "an id is out of range")
    _need(1 <= next_id < 2**32, f"next_id is {next_id}")


_WHOLE = ("component_track", "component_type", "track_id", "anchors")


def _check_undetected(density: Density) -> None:
    seen = density.undetected
    count = len(seen.viewpoint_looks)
    _array("viewpoints", seen.viewpoints, (count, 2), whole=False)
    _array("viewpoint_looks", seen.viewpoint_looks, (count,), whole=True)
    _need(seen.looks >= 0 and bool((seen.viewpoint_looks >= 0).all()), "looks are below 0")


def _check_inactive(inactive: InactiveGrid, parameters: Mapping[str, Any]) -> None:
    _need(0.0 <= inactive.largest_distance <= LARGEST, "a reactivation distance is out of range")
    landmarks = inactive.landmarks
    if landmarks is None:
        return
    size = max(float(parameters["sp_field_of_view"]), SMALLEST_CELL)
    index = np.array(list(inactive.cells), np.float64)
    counts = [len(cell) for cell in inactive.cells.values()]
    at_home = np.floor(landmarks.position[:, :2] / size) == np.repeat(index, counts, axis=0)
    _need(min(counts) > 0 and bool(at_home.all()), "a cell has landmarks of elsewhere, or none")
    _check_landmarks(landmarks, inactive.largest_distance)


def _check_landmarks(landmarks: InactiveLandmarks, largest: float) -> None:
    for name in ("existence", "position", "origin", "axes", "q", "anchor_q", "gain"):
        _numbers(name, getattr(landmarks, name))
    distance = landmarks.reactivation_distance
    _numbers("reactivation_distance", distance)
    for name in ("track_id", "anchors"):
        _need(getattr(landmarks, name).dtype == np.int64, f"'{name}' is not of whole numbers")
    _probabilities("existence", landmarks.existence)
    in_range = (distance >= 0.0) & (distance <= largest)
    _need(bool(in_range.all()), "a reactivation distance is out of range")
    _need(bool((landmarks.anchors >= 0).all()), "an anchor has a negative id")
    _frames(landmarks.axes)
    _covariance("covariance", landmarks.covariance)
    _covariance("residual", landmarks.residual)


def _array(name: str, array: FloatArray | IntArray, shape: tuple[int, ...], *, whole: bool) -> None:
    _need(array.shape == shape, f"'{name}' has the shape {array.shape}, not {shape}")
    _need((array.dtype == np.int64) == whole, f"'{name}' has the type {array.dtype}")
    if not whole:
        _numbers(name, array)


def _numbers(name: str, array: FloatArray | IntArray) -> None:
    _need(array.dtype == np.float64, f"'{name}' has the type {array.dtype}")
    _need(bool((np.abs(array) <= LARGEST).all()), f"'{name}' has a number that is not plausible")


def _probabilities(name: str, array: FloatArray) -> None:
    _numbers(name, array)
    fine = (array >= 0.0) & (array <= 1.0 + ROUNDING)
    _need(bool(fine.all()), f"'{name}' has a number that is no probability")


def _frames(axes: FloatArray) -> None:
    """Axes must be orthonormal."""
    off = np.swapaxes(axes, 1, 2) @ axes - np.eye(SPACE)
    _need(bool((np.abs(off) < ROUNDING).all()), "axes are not at right angles")


def _covariance(name: str, matrix: FloatArray) -> None:
    """(..., n, n): symmetric and, scaled to correlations, without negative eigenvalues."""
    _numbers(name, matrix)
    variance = np.diagonal(matrix, axis1=-2, axis2=-1)
    _need(bool((variance >= 0.0).all()), f"'{name}' has a negative variance")
    scale = np.sqrt(np.where(variance > 0.0, variance, 1.0))
    correlation = matrix / scale[..., :, None] / scale[..., None, :]
    across = abs(correlation - np.swapaxes(correlation, -1, -2))
    _need(bool((across < ROUNDING).all()), f"'{name}' is not symmetric")
    _need(bool((abs(correlation) < 1.0 + ROUNDING).all()), f"'{name}' is no covariance")
    try:
        np.linalg.cholesky(correlation - LEAST_EIGENVALUE * np.eye(matrix.shape[-1]))
    except np.linalg.LinAlgError as error:
        raise CheckpointError(f"the file makes no sense: '{name}' is no covariance") from error


def _need(holds: bool, otherwise: str) -> None:
    if not holds:
        raise CheckpointError(f"the file makes no sense: {otherwise}")
