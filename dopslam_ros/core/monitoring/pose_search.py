"""Where a vehicle is that has lost its way: a snapshot solution from BS, map and one set of paths.

A path of the BS gives the direction of the vehicle from its departure, the heading from its
arrival; so does one of a virtual anchor, mirrored. From each such start the pose is settled by
Gauss-Newton, paths that fit other landmarks are added one after the other, and what comes out is
weighed with the same association evidence as a step of the filter, so that landmarks that should
have been heard and paths that nothing explains count.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dopslam_ros.core.linalg.arrays import BoolArray, FloatArray, IntArray, wrap_angle
from dopslam_ros.core.models.detection import log_clutter_intensity
from dopslam_ros.core.models.measurements import MeasurementSet
from dopslam_ros.core.monitoring import pose_search_kernels as kernels
from dopslam_ros.core.pmb import FilterParameters, FilterState, Step
from dopslam_ros.core.pmb.coordinates_kernels import components_in_space
from dopslam_ros.core.pmb.inactive import in_space_now, reactivate
from dopslam_ros.core.pmb.likelihood import Observed
from dopslam_ros.core.pmb.observed import prepare
from dopslam_ros.core.pmb.step import update
from dopslam_ros.core.settings.filtering import gates
from dopslam_ros.core.settings.layout import HEADING, VEHICLE, LandmarkType

# Landmarks and types less likely than this are not looked for.
LIKELY = 0.3
# Starts that are followed, and poses that are weighed by the filter's evidence.
MOST_STARTS = 32
MOST_POSES = 6
# A pose known before a set only as far as this: standard deviations [m, m, rad, m].
ANYWHERE = np.array([300.0, 300.0, 3.0, 300.0])
# Information that holds a step of the search where the paths do not determine it, and of what no
# path determines.
DAMPING = {"x": 1e-6, "y": 1e-6, "heading": 1e-2, "clock_bias": 1e-8}
HELD = 1.0
# The vehicle is somewhere on this area [m^2].
AREA = 1e6
# A path departs from an SP's direction at most by so many standard deviations.
OFF_DIRECTION = 5.0
# Poses nearer than this (squared Mahalanobis distance) are the same.
SAME = 25.0
# Share of a pose's covariance with which it is weighed: as good as none.
POINT = 1e-6


@dataclass(frozen=True)
class Clock:
    """What is known of the clock bias before a set: mean and standard deviation [m]."""

    mean: float
    std: float


@dataclass(frozen=True)
class Fix:
    """A place the vehicle may be at.

    Attributes:
        step: the filter's step from there.
        log_evidence: ln of the probability of the set and of the vehicle being there, in the scale
            of ``Associations.log_evidence``.
    """

    step: Step
    log_evidence: float


@dataclass(frozen=True)
class _Landmarks:
    """L landmarks, the BS first."""

    position: FloatArray
    covariance: FloatArray
    kind: IntArray
    log_heard: FloatArray


def fixes(
    base: FilterState,
    measurements: MeasurementSet,
    speed: float,
    clock: Clock,
    parameters: FilterParameters,
) -> list[Fix]:
    """The places that one set allows, the likeliest first.

    Args:
        base: the map; its vehicle does not count.
        measurements: the set.
        speed: v [m/s].
        clock: what is known of the clock.
        parameters: models and settings.

    Raises:
        LinAlgError: the numbers allow no answer.
    """
    observed = prepare(measurements, parameters)
    poses, spreads, odds = solutions(base, observed, speed, clock, parameters)
    found: list[Fix] = []
    for n in distinct(poses, spreads, odds)[:MOST_POSES]:
        away = (poses[n, 3] - clock.mean) / clock.std
        prior = -0.5 * away * away - math.log(math.sqrt(2.0 * math.pi) * clock.std)
        prior -= math.log(2.0 * math.pi * AREA)
        volume = 0.5 * float(np.linalg.slogdet(2.0 * math.pi * spreads[n])[1])
        here = reactivate(placed(base, poses[n], POINT * spreads[n]), parameters)
        # The linearisation and the associations are those at the solution, the prior is none.
        wide = placed(here, poses[n], np.diag(np.square(ANYWHERE)))
        step = update(here, wide, observed, speed, parameters, births=False)
        found.append(Fix(step, step.associations.log_evidence + volume + prior))
    return sorted(found, key=lambda fix: -fix.log_evidence)


def solutions(
    base: FilterState,
    observed: Observed,
    speed: float,
    clock: Clock,
    parameters: FilterParameters,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Poses (N, 4) at which some paths fit, covariances (N, 4, 4), and ln of their odds (N,)."""
    known = _known_landmarks(base, parameters)
    world = kernels.World(
        parameters.bs,
        np.array([parameters.ue_height]),
        np.array([speed]),
        known.position,
        known.covariance,
        known.kind,
        known.log_heard,
        np.array([parameters.sp_field_of_view]),
        _damping(len(base.ue_mean)),
    )
    heard = kernels.Heard(
        observed.values,
        observed.used,
        observed.noise,
        _log_nobodys(observed, parameters),
        gates(parameters.gate_probability),
        _possible(known, observed, parameters),
    )
    paths = len(observed.values)
    room, vehicle = paths * int(np.count_nonzero(known.kind != LandmarkType.SP)), len(base.ue_mean)
    poses, spreads = np.empty((room, vehicle)), np.empty((room, vehicle, vehicle))
    givens, odds = np.empty((room, paths), np.int64), np.empty(room)
    count = kernels.locate(
        world,
        heard,
        np.array([clock.mean, clock.std]),
        MOST_STARTS,
        poses,
        spreads,
        givens,
        odds,
    )
    return poses[:count], spreads[:count], odds[:count]


def _damping(size: int) -> FloatArray:
    """(U,) by component of the vehicle; what no path can tell stays where it is."""
    known = [DAMPING[component.name] for component in VEHICLE]
    return np.array(known + [HELD] * (size - len(known)))


def distinct(poses: FloatArray, spreads: FloatArray, odds: FloatArray) -> list[int]:
    """Which of the poses differ, the likeliest first."""
    kept: list[int] = []
    for n in np.argsort(-odds, kind="stable").tolist():
        if odds[n] == -np.inf:
            break
        if not any(same_place(poses[n], poses[k], spreads[n] + spreads[k]) for k in kept):
            kept.append(n)
    return kept


def same_place(one: FloatArray, other: FloatArray, covariance: FloatArray) -> bool:
    """Whether two poses (U,) are as good as one, given the covariance of what lies between."""
    off = one - other
    off[HEADING] = wrap_angle(off[HEADING])
    return bool(off @ np.linalg.solve(covariance, off) < SAME)


def placed(base: FilterState, pose: FloatArray, covariance: FloatArray) -> FilterState:
    """The same map with the vehicle at a pose that has nothing in common with it."""
    mean, joint = base.mean.copy(), base.covariance.copy()
    vehicle = base.start[0]
    mean[:vehicle] = pose
    joint[:vehicle], joint[:, :vehicle] = 0.0, 0.0
    joint[:vehicle, :vehicle] = covariance
    return base.but(mean=mean, covariance=joint)


def log_lost(measurements: MeasurementSet, parameters: FilterParameters) -> float:
    """ln of the probability of a set of which nothing is foreseen, scaled as for ``Fix``.

    All paths are uniform over the box of clutter, as many as came.
    """
    observed = prepare(measurements, parameters)
    expected = max(len(measurements) - parameters.clutter_mean, 1.0)
    log_rate = math.log(expected + parameters.clutter_mean)
    return float((log_rate - observed.used @ parameters.clutter_log_spans).sum()) - expected


def _known_landmarks(base: FilterState, parameters: FilterParameters) -> _Landmarks:
    """The BS, the components active and those inactive, each where it is now."""
    chance = base.existence[base.component_track] * base.component_weight
    likely = chance > LIKELY
    active, spread = components_in_space(base.density)
    position = [parameters.bs[None], active[likely]]
    covariance = [np.zeros((1, 3, 3)), spread[likely]]
    kind = [np.array([int(LandmarkType.BS)]), base.component_type[likely]]
    chances: Sequence[FloatArray] = [np.ones(1), chance[likely]]
    inactive_landmarks = base.inactive.everybody
    if inactive_landmarks is not None:
        inactive, spread = in_space_now(base, inactive_landmarks)
        position.append(inactive)
        covariance.append(spread)
        kind.append(np.full(len(inactive_landmarks), int(LandmarkType.SP)))
        chances = [*chances, inactive_landmarks.existence]
    heard = max(parameters.detection_probability, 1e-3) * np.concatenate(chances)
    return _Landmarks(
        np.concatenate(position),
        np.concatenate(covariance),
        np.concatenate(kind).astype(np.int64),
        np.log(np.maximum(heard, 1e-6)),
    )


def _log_nobodys(observed: Observed, parameters: FilterParameters) -> FloatArray:
    """(J,) ln of the intensity of paths that are no landmark's; never that of an impossibility."""
    if parameters.clutter_mean > 0.0:
        return log_clutter_intensity(parameters, observed.used)
    return np.asarray(-(observed.used @ parameters.clutter_log_spans))


def _possible(known: _Landmarks, observed: Observed, parameters: FilterParameters) -> BoolArray:
    """(L, J) what may come from which whatever the pose: paths of SPs depart towards them."""
    leg = known.position - parameters.bs
    ground = np.maximum(np.hypot(leg[:, 0], leg[:, 1]), 1e-6)
    direction = np.stack([np.arctan2(leg[:, 1], leg[:, 0]), np.arctan2(leg[:, 2], ground)], axis=1)
    off = observed.values[None, :, 3:5] - direction[:, None]
    off[:, :, 0] = wrap_angle(off[:, :, 0])
    blur = np.trace(known.covariance, axis1=1, axis2=2) / np.square(ground)
    variance = np.diagonal(observed.noise, axis1=1, axis2=2)[None, :, 3:5] + blur[:, None, None]
    near = (np.square(off) <= OFF_DIRECTION**2 * variance) | ~observed.used[None, :, 3:5]
    scattering = known.kind == LandmarkType.SP
    return np.asarray(near.all(axis=2) | ~scattering[:, None])
