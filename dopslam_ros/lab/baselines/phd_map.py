"""The map of EK-PHD SLAM: the GM-PHD update of its intensity, and the reduction of the mixture."""

from __future__ import annotations

import numpy as np
from scipy.special import logsumexp

from dopslam_ros.core.linalg.arrays import FloatArray, symmetrise
from dopslam_ros.core.pmb.birth import Births
from dopslam_ros.core.settings.filtering import FilterParameters
from dopslam_ros.core.settings.layout import NONE, SPACE, UNKNOWN_TYPES
from dopslam_ros.lab.baselines.phd_state import Components, PhdState
from dopslam_ros.lab.baselines.phd_vehicle import Pairs, Vehicle

# Components this near a heavier one (squared Mahalanobis distance, Vo and Ma's U) join it.
MERGE_DISTANCE = 4.0
# At most this many components are kept, the heaviest (their J_max); the paper's scene needs 40.
MOST_COMPONENTS = 200


def updated_map(
    state: PhdState,
    pairs: Pairs,
    vehicle: Vehicle,
    births: Births,
    parameters: FilterParameters,
) -> Components:
    """(1 - p_D) v + sum over z of p_D v N(z; h, S) / (c + rho + integral of p_D v N).

    Of the uniform part of v the second term is the birth from z, with rho for its integral.
    Components that hardly weigh anything are left out.
    """
    log_weights = pairs.log_weights(vehicle.others_shift, vehicle.others_covariance)
    log_total = np.logaddexp(pairs.log_new, logsumexp(log_weights, axis=0))
    detected = np.exp(log_weights - log_total)[1:]
    born = np.exp(births.log_intensity - log_total)
    least = parameters.prune_existence
    missed = Components(
        state.weights * (1.0 - pairs.detection[1:]), state.means, state.covariances, state.types
    )
    parts = (
        missed.at(np.flatnonzero(missed.weights > least)),
        _detections(state, detected, pairs, vehicle, least),
        _born(state.ue_covariance, born, vehicle, births, least),
    )
    return Components(
        np.concatenate([part.weights for part in parts]),
        np.concatenate([part.means for part in parts]),
        np.concatenate([part.covariances for part in parts]),
        np.concatenate([part.types for part in parts]),
    )


def _detections(
    state: PhdState, weights: FloatArray, pairs: Pairs, vehicle: Vehicle, least: float
) -> Components:
    """EKF updates of components with paths, for the pairs (C, J) of enough weight."""
    component, path = np.nonzero(weights > least)
    at = component + 1, path
    s = pairs.total_noise(vehicle.others_covariance)[at]
    projected = pairs.by_landmark[at] @ state.covariances[component]
    gain = np.swapaxes(np.linalg.solve(s, projected), -1, -2)
    innovation = pairs.remainder(vehicle.others_shift)[at]
    return Components(
        weights[component, path],
        state.means[component] + (gain @ innovation[:, :, None])[..., 0],
        symmetrise(state.covariances[component] - gain @ projected),
        state.types[component],
    )


def _born(
    predicted: FloatArray, weights: FloatArray, vehicle: Vehicle, births: Births, least: float
) -> Components:
    """Births (2, J) of enough weight, moved along with the vehicle from where it was predicted."""
    kind, path = np.nonzero(weights > least)
    gain = births.gain[kind, path]
    gained = vehicle.others_covariance[path] - predicted
    covariances = births.covariance[kind, path] + gain @ gained @ np.swapaxes(gain, -1, -2)
    return Components(
        weights[kind, path],
        births.position[kind, path] + (gain @ vehicle.others_shift[path][:, :, None])[..., 0],
        symmetrise(covariances),
        np.array(UNKNOWN_TYPES, dtype=np.int64)[kind],
    )


def merge_near(components: Components) -> Components:
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
    total, mean = np.zeros(len(heads)), np.zeros((len(heads), SPACE))
    np.add.at(total, cluster, weights)
    share = weights / total[cluster]
    np.add.at(mean, cluster, share[:, None] * means)
    deviation = means - mean[cluster]
    about_mean = covariances + deviation[:, :, None] * deviation[:, None, :]
    covariance = np.zeros((len(heads), SPACE, SPACE))
    np.add.at(covariance, cluster, share[:, None, None] * about_mean)
    return Components(total, mean, covariance, types[heads])


def heaviest(components: Components) -> Components:
    """At most MOST_COMPONENTS, the heaviest first."""
    return components.at(np.argsort(-components.weights, kind="stable")[:MOST_COMPONENTS])
