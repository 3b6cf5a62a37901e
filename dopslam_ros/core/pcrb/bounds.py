"""Posterior Cramer-Rao bounds of the joint vehicle and map state (Section III)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from dopslam_ros.core.linalg.arrays import BoolArray, FloatArray, IntArray, floats, integers
from dopslam_ros.core.models.channel import Paths
from dopslam_ros.core.models.motion import ControlSpan, span_rows
from dopslam_ros.core.models.motion_kernels import predict
from dopslam_ros.core.pcrb import bounds_kernels as kernels
from dopslam_ros.core.settings.layout import DIM, DOPPLER
from dopslam_ros.core.settings.model import ModelParameters


@dataclass(frozen=True)
class BoundState:
    """What the recursion carries from one snapshot to the next.

    Attributes:
        covariance: (n, n) inverse of the PIM, J^-1, over [s; x of the landmarks seen].
        ids: (L,) the landmarks in it, in the order of their blocks.
    """

    covariance: FloatArray
    ids: IntArray


class Bounds(NamedTuple):
    """Bounds after a snapshot.

    Attributes:
        peb: position [m].
        heb: heading [rad].
        ceb: clock bias [m].
        leb: (M,) each landmark asked for [m]; infinity until it was seen.
    """

    peb: float
    heb: float
    ceb: float
    leb: FloatArray


class InformationSplit(NamedTuple):
    """Data information with and without the part that Doppler brings, eqs. (22), (23).

    Attributes:
        ue: (4, 4) non-Doppler part of sum A' R^-1 A.
        ue_doppler: (4, 4) Doppler part.
        landmark: (M, 3, 3) non-Doppler part of B' R^-1 B.
        landmark_doppler: (M, 3, 3) Doppler part.
    """

    ue: FloatArray
    ue_doppler: FloatArray
    landmark: FloatArray
    landmark_doppler: FloatArray


def initial_bound(initial_covariance: FloatArray) -> BoundState:
    """The recursion before the first snapshot: the prior of the vehicle, no landmark."""
    return BoundState(np.array(initial_covariance), np.zeros(0, dtype=np.int64))


def predict_bound(
    state: BoundState, ue: FloatArray, spans: Sequence[ControlSpan], noise_rate: FloatArray
) -> BoundState:
    """J_prior of eq. (17) as a covariance: Q + F J^-1 F', the map does not move.

    Args:
        state: before.
        ue: (4,) the true state before, where F is evaluated.
        spans: the controls since then.
        noise_rate: (4,) variance added per second.
    """
    rate = floats(noise_rate)
    _, covariance = predict(floats(ue), floats(state.covariance), span_rows(spans), rate)
    return BoundState(covariance, state.ids)


def update_bound(
    state: BoundState,
    paths: Paths,
    ids: IntArray,
    is_bs: BoolArray,
    weights: FloatArray,
    noise: FloatArray,
    used: BoolArray,
) -> BoundState:
    """J = J_data + J_prior of eq. (17), J_data from the landmarks that are detected.

    Args:
        state: predicted.
        paths: h and its Jacobians at the true state, M landmarks.
        ids: (M,) their ids.
        is_bs: (M,) the landmark is known and has no block in the state.
        weights: (M,) share of the information that counts: 1 detected, 0 not, p_D in expectation.
        noise: (6, 6) or (M, 6, 6) covariance R.
        used: (6,) or (M, 6) the components that each path has.

    Returns:
        The state with the landmarks newly seen appended.

    Raises:
        LinAlgError: R is not positive definite.
    """
    covariance, known, sound = kernels.update(
        floats(state.covariance),
        integers(state.ids),
        floats(paths.ue_jacobian),
        floats(paths.landmark_jacobian),
        paths.degenerate,
        integers(ids),
        is_bs,
        floats(weights),
        floats(noise).reshape(-1, DIM, DIM),
        used.reshape(-1, DIM),
    )
    if not sound:
        raise np.linalg.LinAlgError("the measurement noise is not positive definite")
    return BoundState(covariance, known)


def bounds_of(state: BoundState, ids: IntArray) -> Bounds:
    """PEB, HEB, CEB and, for the landmarks asked for, LEB (below eq. (17))."""
    leb = np.empty(len(ids))
    covariance, known = floats(state.covariance), integers(state.ids)
    return Bounds(*kernels.read_bounds(covariance, known, integers(ids), leb), leb)


def information_split(paths: Paths, model: ModelParameters) -> InformationSplit:
    """What Doppler adds to the data information of vehicle and landmarks, eqs. (22), (23)."""
    precision = np.where(model.used_components, 1.0 / np.square(model.measurement_noise_std), 0.0)
    doppler = np.arange(DIM) == DOPPLER

    def information(jacobian: FloatArray, rows: BoolArray) -> FloatArray:
        weights = np.where(rows, precision, 0.0)
        return np.asarray(np.einsum("mki,k,mkj->mij", jacobian, weights, jacobian))

    return InformationSplit(
        ue=information(paths.ue_jacobian, ~doppler).sum(axis=0),
        ue_doppler=information(paths.ue_jacobian, doppler).sum(axis=0),
        landmark=information(paths.landmark_jacobian, ~doppler),
        landmark_doppler=information(paths.landmark_jacobian, doppler),
    )
