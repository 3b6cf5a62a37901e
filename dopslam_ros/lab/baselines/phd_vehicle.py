"""The vehicle of EK-PHD SLAM: where the best associations of paths to components place it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from dopslam_ros.core.association.assignment import k_best_assignments
from dopslam_ros.core.linalg.arrays import FloatArray, symmetrise
from dopslam_ros.core.models.channel import observe
from dopslam_ros.core.models.detection import detection_probabilities, log_clutter_intensity
from dopslam_ros.core.pmb.birth import Births
from dopslam_ros.core.pmb.hypotheses import LOG_TINY
from dopslam_ros.core.pmb.likelihood import Observed
from dopslam_ros.core.settings.filtering import FilterParameters, gates
from dopslam_ros.core.settings.layout import NONE, SPACE, LandmarkType
from dopslam_ros.lab.baselines.gaussian import gaussian_terms, log_normaliser, masked_residual
from dopslam_ros.lab.baselines.phd_state import PhdState


@dataclass(frozen=True)
class Pairs:
    """Each path against the BS (source 0) and the components, linear in what is uncertain.

    z - h = A ds + B dx + noise, with ds and dx measured from the prediction; zero where not used.

    Attributes:
        by_ue: (C + 1, J, 6, U) A.
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
        """(C + 1, J) ln of w p_D N(z; h, S), the vehicle at ``shift`` (J, U) with (J, U, U).

        -inf outside the gate.
        """
        mismatch, log_determinant = gaussian_terms(
            self.total_noise(covariance), self.remainder(shift)
        )
        log_likelihood = -0.5 * (mismatch + log_determinant + self.log_normaliser)
        weight = self.log_weight[:, None] + log_likelihood
        return np.where(mismatch <= self.gate, weight, -np.inf)

    def remainder(self, shift: FloatArray) -> FloatArray:
        """(C + 1, J, 6) the innovation that is left when the vehicle moves by ``shift`` (J, U)."""
        return self.innovation - (self.by_ue @ shift[:, :, None])[..., 0]

    def total_noise(self, covariance: FloatArray) -> FloatArray:
        """(C + 1, J, 6, 6) S, the vehicle uncertain by ``covariance`` (J, U, U)."""
        return symmetrise(self.noise + self.by_ue @ covariance @ np.swapaxes(self.by_ue, -1, -2))


@dataclass(frozen=True)
class Vehicle:
    """Where the paths place the vehicle, from the prediction on.

    Attributes:
        shift: (U,) of the mean.
        covariance: (U, U).
        others_shift: (J, U) the same by all paths but one.
        others_covariance: (J, U, U).
    """

    shift: FloatArray
    covariance: FloatArray
    others_shift: FloatArray
    others_covariance: FloatArray


def pairs_of(
    state: PhdState,
    observed: Observed,
    births: Births,
    speed: float,
    parameters: FilterParameters,
) -> Pairs:
    positions = np.vstack([parameters.bs, state.means])
    types = np.concatenate([[int(LandmarkType.BS)], state.types]).astype(np.int64)
    covariances = np.concatenate([np.zeros((1, SPACE, SPACE)), state.covariances])
    paths = observe(state.ue_mean, speed, positions, types, parameters.bs, parameters.ue_height)
    ue = np.append(state.ue_mean[:2], parameters.ue_height)
    std = _distance_std(positions - ue, covariances, state.ue_covariance)
    detection = detection_probabilities(parameters, ue, positions, types, std)
    detection = np.where(paths.degenerate, 0.0, detection)

    used = observed.used[None, :, :, None]
    by_landmark = paths.landmark_jacobian[:, None] * used
    noise = observed.noise + by_landmark @ covariances[:, None] @ np.swapaxes(by_landmark, -1, -2)
    log_new = np.logaddexp(
        log_clutter_intensity(parameters, observed.used), logsumexp(births.log_intensity, axis=0)
    )
    with np.errstate(divide="ignore"):
        log_weight = np.log(np.concatenate([[1.0], state.weights]) * detection)
    return Pairs(
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


def place_vehicle(covariance: FloatArray, pairs: Pairs, gamma: int) -> Vehicle:
    """p(s | Z), a mixture over the gamma best associations, matched in its moments.

    The components being independent of each other and of the vehicle, a path adds the information
    A' (R + B P B')^-1 A to it, whatever the others do.

    Args:
        covariance: (U, U) of the predicted vehicle.
        pairs: J paths.
        gamma: number of associations.
    """
    paths = np.arange(len(pairs.log_new))
    predicted = np.broadcast_to(covariance, (len(paths), *covariance.shape))
    gain = pairs.log_weights(np.zeros((len(paths), len(covariance))), predicted)
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
    return Vehicle(shift[0], posterior[0], others_shift, others)


def _matched(
    information: FloatArray, prior: FloatArray, weight: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Moments over H hypotheses of N given information (H, n, U, U + 1): matrix, then vector.

    Returns:
        (n, U) shifts of the mean and (n, U, U) covariances.
    """
    size = len(prior)
    precision, vector = information[..., :size], information[..., size:]
    covariances = np.linalg.solve(np.eye(size) + prior @ precision, prior)  # (P^-1 + L)^-1
    shifts = (covariances @ vector)[..., 0]
    shift = np.einsum("h,hni->ni", weight, shifts)
    deviation = shifts - shift
    between = np.einsum("h,hni,hnj->nij", weight, deviation, deviation)
    return shift, symmetrise(np.einsum("h,hnij->nij", weight, covariances) + between)
