"""Posterior Cramer-Rao bounds of the joint vehicle and map state (Section III)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from dopslam_ros.core.linalg.arrays import (
    BoolArray,
    FloatArray,
    IntArray,
    check_shapes,
    floats,
    integers,
)
from dopslam_ros.core.models.channel import Paths
from dopslam_ros.core.models.motion import ControlSpan, predict, span_rows
from dopslam_ros.core.pcrb import bounds_kernels as kernels
from dopslam_ros.core.pcrb.bounds_kernels import BoundState, PathInformation
from dopslam_ros.core.settings.layout import DIM, DOPPLER
from dopslam_ros.core.settings.model import ModelParameters


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
        ue: (U, U) non-Doppler part of sum A' R^-1 A.
        ue_doppler: (U, U) Doppler part.
        landmark: (M, 3, 3) non-Doppler part of B' R^-1 B.
        landmark_doppler: (M, 3, 3) Doppler part.
    """

    ue: FloatArray
    ue_doppler: FloatArray
    landmark: FloatArray
    landmark_doppler: FloatArray


def initial_bound(initial_covariance: FloatArray) -> BoundState:
    """The recursion before the first snapshot: the prior of the vehicle, no landmark."""
    none = np.zeros(0, dtype=np.int64)
    covariance = floats(np.array(initial_covariance))
    return BoundState(covariance, none, integers(np.array([len(covariance)])))


def predict_bound(
    state: BoundState, ue: FloatArray, spans: Sequence[ControlSpan], noise_rate: FloatArray
) -> BoundState:
    """J_prior of eq. (17) as a covariance: Q + F J^-1 F', the map does not move.

    Args:
        state: before.
        ue: (U,) the true state before, where F is evaluated.
        spans: the controls since then.
        noise_rate: (U,) variance added per second.

    Raises:
        ValueError: the shapes do not fit together.
    """
    vehicle, size = int(state.start[0]), int(state.start[-1])
    check_shapes(
        ue=(ue, (vehicle,)),
        noise_rate=(noise_rate, (vehicle,)),
        covariance=(state.covariance, (size, size)),
    )
    rate = floats(noise_rate)
    _, covariance = predict(floats(ue), state.covariance, span_rows(spans), rate)
    return state._replace(covariance=covariance)


def update_bound(
    state: BoundState,
    paths: Paths,
    ids: IntArray,
    types: IntArray,
    weights: FloatArray,
    noise: FloatArray,
    used: BoolArray,
) -> BoundState:
    """J = J_data + J_prior of eq. (17), J_data from the landmarks that are detected.

    Args:
        state: predicted.
        paths: h and its Jacobians at the true state, M landmarks.
        ids: (M,) their ids.
        types: (M,) LandmarkType; a BS is known and has no block in the state.
        weights: (M,) share of the information that counts: 1 detected, 0 not, p_D in expectation.
        noise: (6, 6) or (M, 6, 6) covariance R.
        used: (6,) or (M, 6) the components that each path has.

    Returns:
        The state with the landmarks newly seen appended.

    Raises:
        ValueError: the shapes do not fit together.
        LinAlgError: R is not positive definite.
    """
    count = len(ids)
    check_shapes(
        ue_jacobian=(paths.ue_jacobian, (count, DIM, int(state.start[0]))),
        types=(types, (count,)),
        weights=(weights, (count,)),
    )
    information = PathInformation(
        floats(paths.ue_jacobian),
        floats(paths.landmark_jacobian),
        floats(np.where(paths.degenerate, 0.0, weights)),
        floats(noise).reshape(-1, DIM, DIM),
        used.reshape(-1, DIM),
    )
    covariance, known, start, sound = kernels.update(
        *state, information, integers(ids), integers(types)
    )
    if not sound:
        raise np.linalg.LinAlgError("the measurement noise is not positive definite")
    return BoundState(covariance, known, start)


def bounds_of(state: BoundState, ids: IntArray) -> Bounds:
    """PEB, HEB, CEB and, for the landmarks asked for, LEB (below eq. (17))."""
    return Bounds(*kernels.read_bounds(*state, integers(ids)))


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
