"""States of the vehicle, maps and bounds as messages."""

from __future__ import annotations

from dataclasses import dataclass
from operator import attrgetter
from typing import Any

import numpy as np

from dopslam_ros.bag import record_type
from dopslam_ros.core.linalg.arrays import FloatArray, IntArray
from dopslam_ros.core.pmb import LandmarkEstimates
from dopslam_ros.core.session.bounding import BoundsOutput, WorldState
from dopslam_ros.core.settings.layout import BS_ID, SPACE, VEHICLE, LandmarkType
from dopslam_ros.messages import topics
from dopslam_ros.messages.common import Frames, InvalidMessage, Types, make_header

# The fields of a UeState that are the vehicle's components.
_FIELDS = tuple(component.name for component in VEHICLE)
_fields = attrgetter(*_FIELDS)


def make_ue_state(
    types: Types, time_ns: int, mean: FloatArray, covariance: FloatArray, frames: Frames
) -> Any:
    """A UeState from the vehicle's mean (U,) and covariance (U, U)."""
    return types(topics.UE_STATE.type_name)(
        header=make_header(types, time_ns, frames.map),
        covariance=np.ascontiguousarray(covariance).reshape(-1),
        **dict(zip(_FIELDS, mean.tolist(), strict=True)),
    )


def read_ue_state(message: Any) -> tuple[FloatArray, FloatArray]:
    """(U,) mean and (U, U) covariance of a UeState.

    Raises:
        InvalidMessage: a number is not finite.
    """
    mean = np.array(_fields(message), np.float64)
    covariance = np.array(message.covariance, np.float64).reshape(len(mean), len(mean))
    if not (np.isfinite(mean).all() and np.isfinite(covariance).all()):
        raise InvalidMessage("state_not_finite", "a UeState holds NaN or infinity")
    return mean, covariance


@dataclass(frozen=True)
class MapArrays:
    """A LandmarkMap as arrays: (L,) ids and types, (L, 3) positions [m], (L, 3, 3) covariances."""

    ids: IntArray
    types: IntArray
    positions: FloatArray
    covariances: FloatArray

    def at(self, ue: FloatArray) -> WorldState:
        """Vehicle (U,) and map together, where bounds can be evaluated."""
        return WorldState(ue, self.ids, self.types, self.positions)

    def of_type(self, kind: LandmarkType) -> FloatArray:
        """(n, 3) positions of the landmarks of a type."""
        return self.positions[self.types == kind]


def read_map(message: Any) -> MapArrays:
    """Arrays of a LandmarkMap.

    Raises:
        InvalidMessage: a position is not finite or a type is unknown.
    """
    landmarks = message.landmarks
    positions = np.array(
        [[m.position.x, m.position.y, m.position.z] for m in landmarks], np.float64
    ).reshape(-1, SPACE)
    kinds = np.array([int(m.type) for m in landmarks], dtype=np.int64)
    if not np.isfinite(positions).all():
        raise InvalidMessage("position_not_finite", "a landmark's position is NaN or infinite")
    if not np.isin(kinds, list(LandmarkType)).all():
        raise InvalidMessage("unknown_type", "a landmark's type is none of BS, VA, SP")
    covariances = np.array([m.covariance for m in landmarks], np.float64).reshape(-1, SPACE, SPACE)
    ids = np.array([int(m.id) for m in landmarks], dtype=np.int64)
    return MapArrays(ids, kinds, positions, covariances)


def make_map(
    types: Types, time_ns: int, landmarks: LandmarkEstimates, bs: FloatArray, frames: Frames
) -> Any:
    """A LandmarkMap: the BS with id 0, then the landmarks."""
    entries = np.zeros(1 + len(landmarks.ids), record_type("dopslam_msgs/msg/Landmark"))
    # The place of the BS is known: no covariance.
    for name, of_bs, of_others in (
        ("id", BS_ID, landmarks.ids),
        ("type", LandmarkType.BS, landmarks.types),
        ("type_probabilities", (1.0, 0.0, 0.0), landmarks.type_probabilities),
        ("existence_probability", 1.0, landmarks.existence),
        ("covariance", 0.0, landmarks.covariances.reshape(-1, SPACE * SPACE)),
    ):
        entries[name][0] = of_bs
        entries[name][1:] = of_others
    for number, name in enumerate("xyz"):
        entries["position"][name][0] = bs[number]
        entries["position"][name][1:] = landmarks.positions[:, number]
    return types(topics.LANDMARKS.type_name)(
        header=make_header(types, time_ns, frames.map), landmarks=entries
    )


def true_landmarks(positions: FloatArray, kinds: IntArray) -> LandmarkEstimates:
    """The true landmarks (L, 3), (L,) as if estimated without error; ids from 1 on."""
    count = len(kinds)
    return LandmarkEstimates(
        ids=np.arange(1, count + 1),
        types=kinds,
        type_probabilities=np.eye(len(LandmarkType))[kinds],
        existence=np.ones(count),
        positions=positions,
        covariances=np.zeros((count, SPACE, SPACE)),
    )


def make_bounds(types: Types, output: BoundsOutput, frames: Frames) -> Any:
    """An ErrorBounds."""
    full, plain = output.with_doppler, output.without_doppler
    landmarks = np.zeros(len(output.ids), record_type("dopslam_msgs/msg/LandmarkBound"))
    landmarks["id"], landmarks["type"] = output.ids, output.types
    landmarks["leb"], landmarks["leb_without_doppler"] = full.leb, plain.leb
    return types(topics.BOUNDS.type_name)(
        header=make_header(types, output.stamp_ns, frames.map),
        peb=full.peb,
        heb=full.heb,
        ceb=full.ceb,
        peb_without_doppler=plain.peb,
        heb_without_doppler=plain.heb,
        ceb_without_doppler=plain.ceb,
        landmarks=landmarks,
    )
