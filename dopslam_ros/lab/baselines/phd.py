"""EK-PHD SLAM: the map as an intensity instead of a list of landmarks; a baseline for studies.

After Kaltiokallio, Ge, Talvitie, Wymeersch, Valkama, "mmWave Simultaneous Localization and Mapping
Using a Computationally Efficient EK-PHD Filter", 2021. Only its abstract and introduction could be
consulted: Gaussian approximations of first order, in x, y, z. The rest is the plainest reading of
that, with the models, births and settings of the EK-PMB filter:

- the vehicle is N(s, P), the map a Poisson process independent of it, whose intensity is a Gaussian
  mixture over VAs and SPs plus a uniform part, never detected so far;
- the vehicle is updated with the gamma best associations of paths to components, moment-matched;
- the map follows the GM-PHD recursion of Vo and Ma 2006. In its update with a path the vehicle is
  integrated out as all *other* paths place it, which is the marginal of a joint Gaussian update; no
  path is counted twice. The correlation of vehicle and map is then dropped.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.special import logsumexp

from dopslam_ros.core.association.assignment import k_best_assignments
from dopslam_ros.core.linalg.arrays import FloatArray, IntArray, symmetrise, wrap_angle
from dopslam_ros.core.models.channel import observe
from dopslam_ros.core.models.detection import detection_probabilities, log_clutter_intensity
from dopslam_ros.core.models.measurements import MeasurementSet
from dopslam_ros.core.models.motion import ControlSpan, predict_covariance, propagate_spans
from dopslam_ros.core.pmb.birth import Births
from dopslam_ros.core.pmb.density import Undetected
from dopslam_ros.core.pmb.estimates import LandmarkEstimates
from dopslam_ros.core.pmb.hypotheses import LOG_TINY
from dopslam_ros.core.pmb.likelihood import Observed
from dopslam_ros.core.pmb.observed import gaussian_terms, log_normaliser, masked_residual, prepare
from dopslam_ros.core.pmb.state import FilterState, initial_filter_state
from dopslam_ros.core.pmb.undetected import looked_from, nothing_seen
from dopslam_ros.core.settings.filtering import FilterParameters, gates
from dopslam_ros.core.settings.layout import NONE, UE, UNKNOWN_TYPES, LandmarkType
from dopslam_ros.lab.baselines.births import propose

# Components this near a heavier one (squared Mahalanobis distance, Vo and Ma's U) join it.
MERGE_DISTANCE = 4.0
# At most this many components are kept, the heaviest (their J_max); the paper's scene needs 40.
MOST_COMPONENTS = 200


@dataclass(frozen=True)
class PhdState:
    """A Gaussian vehicle and, independent of it, the intensity (PHD) of the map.

    Attributes:
        ue_mean: (4,) x [m], y [m], heading [rad], clock bias [m].
        ue_covariance: (4, 4).
        weights: (C,) expected number of landmarks that each component stands for.
        means: (C, 3) [m].
        covariances: (C, 3, 3) [m^2].
        types: (C,) VA or SP.
        undetected: where the intensity is still that of landmarks never detected.
    """

    ue_mean: FloatArray
    ue_covariance: FloatArray
    weights: FloatArray
    means: FloatArray
    covariances: FloatArray
    types: IntArray
    undetected: Undetected


def initial_phd(parameters: FilterParameters) -> PhdState:
    """The density before the first snapshot: the prior of the vehicle and an unknown map."""
    return PhdState(
        ue_mean=np.array(parameters.initial_state),
        ue_covariance=parameters.initial_covariance,
        weights=np.zeros(0),
        means=np.zeros((0, 3)),
        covariances=np.zeros((0, 3, 3)),
        types=np.zeros(0, dtype=np.int64),
        undetected=nothing_seen(),
    )


def phd_step(
    state: PhdState,
    measurements: MeasurementSet,
    spans: Sequence[ControlSpan],
    speed: float,
    parameters: FilterParameters,
) -> PhdState:
    """One recursion: predict, place the vehicle, update the map, reduce the mixture.

    Args:
        state: after the previous snapshot.
        measurements: the snapshot, J paths.
        spans: controls since the previous snapshot; empty for the first one.
        speed: v at the snapshot [m/s].
        parameters: models and settings; ``coupling`` and ``density`` mean nothing here.
    """
    state = _predict(state, spans, parameters)
    without_map = _without_map(state, parameters)
    observed = prepare(measurements, parameters)
    births = propose(without_map, observed, speed, parameters)
    pairs = _pairs(state, observed, births, speed, parameters)
    vehicle = _place_vehicle(state.ue_covariance, pairs, parameters.gamma)
    components = _updated_map(state, pairs, vehicle, births, parameters)
    ue_mean = state.ue_mean + vehicle.shift
    ue_mean[2] = wrap_angle(ue_mean[2])
    return PhdState(
        ue_mean,
        vehicle.covariance,
        *_heaviest(_merged(components)),
        undetected=looked_from(state.undetected, ue_mean[:2], parameters),
    )


def phd_landmarks(state: PhdState, parameters: FilterParameters) -> LandmarkEstimates:
    """The components that stand for a landmark of known place, as a GM-PHD filter reports them.

    A PHD has no labels: the ids are 1 ... L, the heaviest first, and mean nothing beyond the step.
    """
    spread = np.sqrt(np.trace(state.covariances, axis1=1, axis2=2))
    shown = (state.weights >= parameters.report_existence) & (spread <= parameters.report_std)
    types = state.types[shown]
    return LandmarkEstimates(
        ids=np.arange(1, len(types) + 1, dtype=np.int64),
        types=types,
        type_probabilities=np.eye(len(LandmarkType))[types],
        existence=np.minimum(state.weights[shown], 1.0),
        positions=state.means[shown],
        covariances=state.covariances[shown],
    )


class _Components(NamedTuple):
    """A Gaussian mixture, fields as in PhdState."""

    weights: FloatArray
    means: FloatArray
    covariances: FloatArray
    types: IntArray

    def at(self, index: IntArray) -> _Components:
        """Those at ``index``."""
        return _Components(
            self.weights[index], self.means[index], self.covariances[index], self.types[index]
        )


@dataclass(frozen=True)
class _Pairs:
    """Each path against the BS (source 0) and the components, linear in what is uncertain.

    z - h = A ds + B dx + noise, with ds and dx measured from the prediction; zero where not used.

    Attributes:
        by_ue: (C + 1, J, 6, 4) A.
        by_landmark: (C + 1, J, 6, 3) B.
        noise: (C + 1, J, 6, 6) of the path and of the landmark, R + B P B'; not of the vehicle.
        innovation: (C + 1, J, 6) z - h.
        detection: (C + 1,) p_D.
        log_weight: (C + 1,) ln of weight times p_D.
        log_normaliser: (J,) d ln(2 pi), d the number of components used.
        gate: (J,) largest squared Mahalanobis distance.
        log_new: (J,) ln of the intensity of clutter and undetected landmarks, c + rho.
    """

    by_ue: FloatArray
    by_landmark: FloatArray
    noise: FloatArray
    innovation: FloatArray
    detection: FloatArray
    log_weight: FloatArray
    log_normaliser: FloatArray
    gate: FloatArray
    log_new: FloatArray

    def log_weights(self, shift: FloatArray, covariance: FloatArray) -> FloatArray:
        """(C + 1, J) ln of w p_D N(z; h, S), the vehicle at ``shift`` (J, 4) with (J, 4, 4).

        -inf outside the gate.
        """
        mismatch, log_determinant = gaussian_terms(
            self.total_noise(covariance), self.remainder(shift)
        )
        log_likelihood = -0.5 * (mismatch + log_determinant + self.log_normaliser)
        weight = self.log_weight[:, None] + log_likelihood
        return np.where(mismatch <= self.gate, weight, -np.inf)

    def remainder(self, shift: FloatArray) -> FloatArray:
        """(C + 1, J, 6) the innovation that is left when the vehicle moves by ``shift`` (J, 4)."""
        return self.innovation - (self.by_ue @ shift[:, :, None])[..., 0]

    def total_noise(self, covariance: FloatArray) -> FloatArray:
        """(C + 1, J, 6, 6) S, the vehicle uncertain by ``covariance`` (J, 4, 4)."""
        return symmetrise(self.noise + self.by_ue @ covariance @ np.swapaxes(self.by_ue, -1, -2))


@dataclass(frozen=True)
class _Vehicle:
    """Where the paths place the vehicle, from the prediction on.

    Attributes:
        shift: (4,) of the mean.
        covariance: (4, 4).
        others_shift: (J, 4) the same by all paths but one.
        others_covariance: (J, 4, 4).
    """

    shift: FloatArray
    covariance: FloatArray
    others_shift: FloatArray
    others_covariance: FloatArray


def _predict(
    state: PhdState, spans: Sequence[ControlSpan], parameters: FilterParameters
) -> PhdState:
    """The vehicle moves; the map is static and no landmark dies."""
    ue_mean, jacobian, noise = propagate_spans(state.ue_mean, spans, parameters.noise_rate)
    covariance = predict_covariance(state.ue_covariance, jacobian, noise)
    return replace(state, ue_mean=ue_mean, ue_covariance=covariance)


def _without_map(state: PhdState, parameters: FilterParameters) -> FilterState:
    """Vehicle and undetected landmarks, which is what the births of the EK-PMB filter look at."""
    return initial_filter_state(parameters).but(
        mean=state.ue_mean,
        covariance=state.ue_covariance,
        undetected=state.undetected,
    )


def _pairs(
    state: PhdState,
    observed: Observed,
    births: Births,
    speed: float,
    parameters: FilterParameters,
) -> _Pairs:
    positions = np.vstack([parameters.bs, state.means])
    types = np.concatenate([[int(LandmarkType.BS)], state.types]).astype(np.int64)
    covariances = np.concatenate([np.zeros((1, 3, 3)), state.covariances])
    paths = observe(state.ue_mean, speed, positions, types, parameters.bs, parameters.ue_height)
    ue = np.append(state.ue_mean[:2], parameters.ue_height)
    spread = _distance_std(positions - ue, covariances, state.ue_covariance)
    detection = detection_probabilities(parameters, ue, positions, types, spread)
    detection = np.where(paths.degenerate, 0.0, detection)

    used = observed.used[None, :, :, None]
    by_landmark = paths.landmark_jacobian[:, None] * used
    noise = observed.noise + by_landmark @ covariances[:, None] @ np.swapaxes(by_landmark, -1, -2)
    log_new = np.logaddexp(
        log_clutter_intensity(parameters, observed.used), logsumexp(births.log_intensity, axis=0)
    )
    with np.errstate(divide="ignore"):
        log_weight = np.log(np.concatenate([[1.0], state.weights]) * detection)
    return _Pairs(
        by_ue=paths.ue_jacobian[:, None] * used,
        by_landmark=by_landmark,
        noise=symmetrise(noise),
        innovation=masked_residual(observed, paths.mean[:, None, :]),
        detection=detection,
        log_weight=log_weight,
        log_normaliser=log_normaliser(observed),
        gate=gates(parameters.gate_probability)[observed.used.sum(axis=1)],
        # A path that nothing explains must still go somewhere.
        log_new=np.maximum(log_new, LOG_TINY),
    )


def _distance_std(
    offset: FloatArray, covariances: FloatArray, ue_covariance: FloatArray
) -> FloatArray:
    """(M,) standard deviation of the length of offsets (M, 3) from the vehicle [m], first order."""
    direction = offset / np.maximum(np.linalg.norm(offset, axis=1), 1e-6)[:, None]
    relative = np.array(covariances)
    relative[:, :2, :2] += ue_covariance[:2, :2]
    return np.asarray(np.sqrt(np.einsum("mi,mij,mj->m", direction, relative, direction)))


def _place_vehicle(covariance: FloatArray, pairs: _Pairs, gamma: int) -> _Vehicle:
    """p(s | Z), a mixture over the gamma best associations, matched in its moments.

    The components being independent of each other and of the vehicle, a path adds the information
    A' (R + B P B')^-1 A to it, whatever the others do.

    Args:
        covariance: (4, 4) of the predicted vehicle.
        pairs: J paths.
        gamma: number of associations.
    """
    paths = np.arange(len(pairs.log_new))
    predicted = np.broadcast_to(covariance, (len(paths), UE, UE))
    gain = pairs.log_weights(np.zeros((len(paths), UE)), predicted)
    # A Poisson component without a path costs nothing; the BS, which surely exists, was missed.
    gain[0] -= np.log(np.maximum(1.0 - pairs.detection[0], np.exp(LOG_TINY)))
    association = k_best_assignments(-gain.T, -pairs.log_new, gamma)
    weight = np.exp(-association.costs - logsumexp(-association.costs))

    right = np.concatenate([pairs.by_ue, pairs.innovation[..., None]], axis=-1)
    information = np.swapaxes(pairs.by_ue, -1, -2) @ np.linalg.solve(pairs.noise, right)
    taken = (association.columns != NONE)[:, :, None, None]
    added = np.where(taken, information[association.columns, paths], 0.0)
    # Of all paths but one without a difference, which would cancel: those before plus those after.
    padded = np.pad(added, ((0, 0), (1, 1), (0, 0), (0, 0)))
    before = np.cumsum(padded[:, :-1], axis=1)
    after = np.cumsum(padded[:, :0:-1], axis=1)[:, ::-1]
    shift, posterior = _matched(before[:, -1:], covariance, weight)
    others_shift, others = _matched(before[:, :-1] + after[:, 1:], covariance, weight)
    return _Vehicle(shift[0], posterior[0], others_shift, others)


def _matched(
    information: FloatArray, prior: FloatArray, weight: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Moments over H hypotheses of N given information (H, n, 4, 5): matrix, then vector.

    Returns:
        (n, 4) shifts of the mean and (n, 4, 4) covariances.
    """
    precision, vector = information[..., :UE], information[..., UE:]
    covariances = np.linalg.solve(np.eye(UE) + prior @ precision, prior)  # (P^-1 + L)^-1
    shifts = (covariances @ vector)[..., 0]
    shift = np.einsum("h,hni->ni", weight, shifts)
    deviation = shifts - shift
    spread = np.einsum("h,hni,hnj->nij", weight, deviation, deviation)
    return shift, symmetrise(np.einsum("h,hnij->nij", weight, covariances) + spread)


def _updated_map(
    state: PhdState,
    pairs: _Pairs,
    vehicle: _Vehicle,
    births: Births,
    parameters: FilterParameters,
) -> _Components:
    """(1 - p_D) v + sum over z of p_D v N(z; h, S) / (c + rho + integral of p_D v N).

    Of the uniform part of v the second term is the birth from z, with rho for its integral.
    Components that hardly weigh anything are left out.
    """
    log_weights = pairs.log_weights(vehicle.others_shift, vehicle.others_covariance)
    log_total = np.logaddexp(pairs.log_new, logsumexp(log_weights, axis=0))
    detected = np.exp(log_weights - log_total)[1:]
    born = np.exp(births.log_intensity - log_total)
    least = parameters.prune_existence
    missed = _Components(
        state.weights * (1.0 - pairs.detection[1:]), state.means, state.covariances, state.types
    )
    parts = (
        missed.at(np.flatnonzero(missed.weights > least)),
        _detections(state, detected, pairs, vehicle, least),
        _born(state.ue_covariance, born, vehicle, births, least),
    )
    return _Components(
        np.concatenate([part.weights for part in parts]),
        np.concatenate([part.means for part in parts]),
        np.concatenate([part.covariances for part in parts]),
        np.concatenate([part.types for part in parts]),
    )


def _detections(
    state: PhdState, weights: FloatArray, pairs: _Pairs, vehicle: _Vehicle, least: float
) -> _Components:
    """EKF updates of components with paths, for the pairs (C, J) of enough weight."""
    component, path = np.nonzero(weights > least)
    at = component + 1, path
    s = pairs.total_noise(vehicle.others_covariance)[at]
    projected = pairs.by_landmark[at] @ state.covariances[component]
    gain = np.swapaxes(np.linalg.solve(s, projected), -1, -2)
    innovation = pairs.remainder(vehicle.others_shift)[at]
    return _Components(
        weights[component, path],
        state.means[component] + (gain @ innovation[:, :, None])[..., 0],
        symmetrise(state.covariances[component] - gain @ projected),
        state.types[component],
    )


def _born(
    predicted: FloatArray, weights: FloatArray, vehicle: _Vehicle, births: Births, least: float
) -> _Components:
    """Births (2, J) of enough weight, moved along with the vehicle from where it was predicted."""
    kind, path = np.nonzero(weights > least)
    gain = births.gain[kind, path]
    gained = vehicle.others_covariance[path] - predicted
    covariances = births.covariance[kind, path] + gain @ gained @ np.swapaxes(gain, -1, -2)
    return _Components(
        weights[kind, path],
        births.position[kind, path] + (gain @ vehicle.others_shift[path][:, :, None])[..., 0],
        symmetrise(covariances),
        np.array(UNKNOWN_TYPES, dtype=np.int64)[kind],
    )


def _merged(components: _Components) -> _Components:
    """The heaviest component of a type takes up those near it, then the next (Vo and Ma 2006)."""
    weights, means, covariances, types = components
    cluster = np.full(len(weights), NONE, dtype=np.int64)
    heads: list[int] = []
    for head in np.argsort(-weights, kind="stable").tolist():
        if cluster[head] != NONE:
            continue
        free = np.flatnonzero((cluster == NONE) & (types == types[head]))
        offset = means[free] - means[head]
        white = np.linalg.solve(covariances[free], offset[:, :, None])[..., 0]
        near = np.einsum("ni,ni->n", offset, white) <= MERGE_DISTANCE
        cluster[free[near]] = len(heads)
        heads.append(head)
    total, mean = np.zeros(len(heads)), np.zeros((len(heads), 3))
    np.add.at(total, cluster, weights)
    share = weights / total[cluster]
    np.add.at(mean, cluster, share[:, None] * means)
    deviation = means - mean[cluster]
    spread = covariances + deviation[:, :, None] * deviation[:, None, :]
    covariance = np.zeros((len(heads), 3, 3))
    np.add.at(covariance, cluster, share[:, None, None] * spread)
    return _Components(total, mean, covariance, types[heads])


def _heaviest(components: _Components) -> _Components:
    """At most MOST_COMPONENTS, the heaviest first."""
    return components.at(np.argsort(-components.weights, kind="stable")[:MOST_COMPONENTS])
