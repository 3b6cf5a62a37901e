"""The pose of a vehicle that is lost: a snapshot solution from BS, map and one set of paths.

A path of the BS gives the direction of the vehicle from its departure, the heading from its
arrival; so does one of a virtual anchor, mirrored. From each such start the pose is settled by
Gauss-Newton, paths that fit other landmarks are added one after the other, and what comes out is
weighed with the same evidence as a step of the filter, so that landmarks that should have been
heard and paths that nothing explains count.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dopslam_ros.core.linalg.arrays import BoolArray, FloatArray, wrap_angle
from dopslam_ros.core.models.detection import log_clutter_intensity
from dopslam_ros.core.monitoring.pose_problem import POSE, Clock, Landmarks, Paths, Problem
from dopslam_ros.core.monitoring.pose_search_kernels import locate
from dopslam_ros.core.pmb import Associations, FilterParameters, Posterior
from dopslam_ros.core.pmb.coordinates_kernels import components_in_space
from dopslam_ros.core.pmb.density import Density
from dopslam_ros.core.pmb.inactive import current_in_space, reactivate
from dopslam_ros.core.pmb.likelihood import Observed
from dopslam_ros.core.pmb.step import update
from dopslam_ros.core.settings.filtering import gates
from dopslam_ros.core.settings.layout import (
    AOD_AZIMUTH,
    AOD_ELEVATION,
    CLOCK_BIAS,
    HEADING,
    SPACE,
    LandmarkType,
)

# Landmarks and types less likely than this are not looked for.
LIKELY = 0.3
# Starts that are followed, and poses that are weighed by the filter's evidence.
MOST_STARTS = 32
MOST_POSES = 6
# A pose known before a set only as far as this: standard deviations [m, m, rad, m].
ANYWHERE = np.array([300.0, 300.0, 3.0, 300.0])
# The vehicle is somewhere on this area [m^2].
AREA = 1e6
# A path departs from an SP's direction at most by so many standard deviations.
OFF_DIRECTION = 5.0
# Poses nearer than this (squared Mahalanobis distance) are the same.
SAME = 25.0
# Share of a pose's covariance with which it is weighed: as good as none.
POINT = 1e-6


@dataclass(frozen=True)
class Fix:
    """A pose the vehicle may have.

    Attributes:
        posterior: after the filter's step from there.
        associations: of that step.
        log_evidence: ln of the probability of the set and of the pose, in the scale of
            ``Associations.log_evidence``.
    """

    posterior: Posterior
    associations: Associations
    log_evidence: float


def fixes(
    base: Posterior,
    observed: Observed,
    speed: float,
    clock: Clock,
    parameters: FilterParameters,
) -> list[Fix]:
    """The poses that one set allows, the likeliest first.

    Args:
        base: the map, that of the likeliest hypothesis; its vehicle does not count.
        observed: the set.
        speed: v [m/s].
        clock: what is known of the clock.
        parameters: models and settings.

    Raises:
        LinAlgError: the numbers allow no answer.
    """
    poses, covariances, log_odds = solutions(base, observed, speed, clock, parameters)
    found: list[Fix] = []
    for n in distinct(poses, covariances, log_odds)[:MOST_POSES]:
        off = (poses[n, CLOCK_BIAS] - clock.mean) / clock.std
        prior = -0.5 * off * off - math.log(math.sqrt(2.0 * math.pi) * clock.std)
        prior -= math.log(2.0 * math.pi * AREA)
        volume = 0.5 * float(np.linalg.slogdet(2.0 * math.pi * covariances[n])[1])
        here = with_pose(base.density, poses[n], POINT * covariances[n])
        here, inactive = reactivate(here, base.inactive[0], parameters)
        # The linearisation and the associations are those at the solution, the prior is none.
        wide = with_pose_unknown(here, poses[n])
        posterior, associations = update(
            here, wide, inactive, observed, speed, parameters, births=False
        )
        log_evidence = associations.log_evidence + volume + prior
        found.append(Fix(posterior, associations, log_evidence))
    return sorted(found, key=lambda fix: -fix.log_evidence)


def solutions(
    base: Posterior,
    observed: Observed,
    speed: float,
    clock: Clock,
    parameters: FilterParameters,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Poses (N, 4) at which some paths fit, covariances (N, 4, 4), and ln of their odds (N,)."""
    landmarks = _known_landmarks(base, parameters)
    paths = Paths(
        observed.values,
        observed.used,
        observed.noise,
        _log_clutter(observed, parameters),
        _possible(landmarks, observed, parameters),
    )
    problem = Problem(
        parameters.bs,
        float(parameters.ue_height),
        float(speed),
        float(parameters.sp_field_of_view),
        gates(parameters.gate_probability),
        Clock(float(clock.mean), float(clock.std)),
        landmarks,
        paths,
    )
    return locate(problem, MOST_STARTS)


def distinct(poses: FloatArray, covariances: FloatArray, log_odds: FloatArray) -> list[int]:
    """Which of the poses differ, the likeliest first."""
    kept: list[int] = []
    for n in np.argsort(-log_odds, kind="stable").tolist():
        if log_odds[n] == -np.inf:
            break
        if not any(same_pose(poses[n], poses[k], covariances[n] + covariances[k]) for k in kept):
            kept.append(n)
    return kept


def same_pose(one: FloatArray, other: FloatArray, covariance: FloatArray) -> bool:
    """Whether two poses (4,) are as good as one, given the covariance of what lies between."""
    off = one - other
    off[HEADING] = wrap_angle(off[HEADING])
    return bool(off @ np.linalg.solve(covariance, off) < SAME)


def with_pose(base: Density, pose: FloatArray, covariance: FloatArray) -> Density:
    """p(s) p(X): the same map with the vehicle at a pose (4,) that is independent of it.

    What else is known of the vehicle stays, but is independent of pose and map, too.
    """
    mean, joint, vehicle = base.mean.copy(), base.covariance.copy(), base.start[0]
    own = base.ue_covariance.copy()
    own[POSE, :], own[:, POSE] = 0.0, 0.0
    own[np.ix_(POSE, POSE)] = covariance
    mean[list(POSE)] = pose
    joint[:vehicle], joint[:, :vehicle] = 0.0, 0.0
    joint[:vehicle, :vehicle] = own
    return base._replace(mean=mean, covariance=joint)


def with_pose_unknown(base: Density, pose: FloatArray) -> Density:
    """The same map with the vehicle anywhere, nominally at a pose (4,)."""
    return with_pose(base, pose, np.diag(np.square(ANYWHERE)))


def log_lost(observed: Observed, parameters: FilterParameters) -> float:
    """ln of the probability of a set of which nothing is foreseen, scaled as for ``Fix``.

    All paths are uniform over the box of clutter, as many as came.
    """
    expected = max(len(observed.values) - parameters.clutter_mean, 1.0)
    log_rate = math.log(expected + parameters.clutter_mean)
    return float((log_rate - observed.used @ parameters.clutter_log_spans).sum()) - expected


def _known_landmarks(base: Posterior, parameters: FilterParameters) -> Landmarks:
    """The BS, the components active and those inactive, each where it is now."""
    density, inactive = base.density, base.inactive[0].landmarks
    probability = density.existence[density.component_track] * density.component_weight
    likely = probability > LIKELY
    active, active_covariance = components_in_space(density)
    position = [parameters.bs[None], active[likely]]
    covariance = [np.zeros((1, SPACE, SPACE)), active_covariance[likely]]
    kind = [np.array([int(LandmarkType.BS)]), density.component_type[likely]]
    probabilities: Sequence[FloatArray] = [np.ones(1), probability[likely]]
    if inactive is not None:
        inactive_position, inactive_covariance = current_in_space(density, inactive)
        position.append(inactive_position)
        covariance.append(inactive_covariance)
        kind.append(np.full(len(inactive), int(LandmarkType.SP)))
        probabilities = [*probabilities, inactive.existence]
    detection = max(parameters.detection_probability, 1e-3) * np.concatenate(probabilities)
    return Landmarks(
        np.concatenate(position),
        np.concatenate(covariance),
        np.concatenate(kind).astype(np.int64),
        np.log(np.maximum(detection, 1e-6)),
    )


def _log_clutter(observed: Observed, parameters: FilterParameters) -> FloatArray:
    """(J,) ln of the intensity of paths that are no landmark's; never that of an impossibility."""
    if parameters.clutter_mean > 0.0:
        return log_clutter_intensity(parameters, observed.used)
    return np.asarray(-(observed.used @ parameters.clutter_log_spans))


def _possible(landmarks: Landmarks, observed: Observed, parameters: FilterParameters) -> BoolArray:
    """(L, J) what may come from which whatever the pose: paths of SPs depart towards them."""
    departure = slice(AOD_AZIMUTH, AOD_ELEVATION + 1)
    leg = landmarks.position - parameters.bs
    ground = np.maximum(np.hypot(leg[:, 0], leg[:, 1]), 1e-6)
    direction = np.stack([np.arctan2(leg[:, 1], leg[:, 0]), np.arctan2(leg[:, 2], ground)], axis=1)
    off = observed.values[None, :, departure] - direction[:, None]
    off[:, :, 0] = wrap_angle(off[:, :, 0])
    uncertain = np.trace(landmarks.covariance, axis1=1, axis2=2) / np.square(ground)
    noise = np.diagonal(observed.noise, axis1=1, axis2=2)[None, :, departure]
    variance = noise + uncertain[:, None, None]
    near = (np.square(off) <= OFF_DIRECTION**2 * variance) | ~observed.used[None, :, departure]
    scattering = landmarks.kind == LandmarkType.SP
    return np.asarray(near.all(axis=2) | ~scattering[:, None])
