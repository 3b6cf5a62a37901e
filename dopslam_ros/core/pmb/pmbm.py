"""The PMBM density: several global hypotheses, each a PMB of its own; with one of them the PMB."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from dopslam_ros.core.linalg.arrays import FloatArray, IntArray, symmetrise, wrap_angle
from dopslam_ros.core.models.measurements import MeasurementSet
from dopslam_ros.core.models.motion import ControlSpan
from dopslam_ros.core.pmb import pmbm_kernels as kernels
from dopslam_ros.core.pmb.estimates import LandmarkEstimates, reported_landmarks
from dopslam_ros.core.pmb.inactive import deactivate
from dopslam_ros.core.pmb.likelihood import Observed
from dopslam_ros.core.pmb.merge import Conditioned
from dopslam_ros.core.pmb.observed import prepare
from dopslam_ros.core.pmb.state import FilterState, initial_filter_state
from dopslam_ros.core.pmb.step import NOT_POSITIVE, advance, step
from dopslam_ros.core.pmb.step_kernels import Associations, DataAssociation, condition_on, posterior
from dopslam_ros.core.settings.filtering import FilterParameters
from dopslam_ros.core.settings.layout import HEADING


@dataclass(frozen=True)
class Mixture:
    """The density of vehicle and map.

    Attributes:
        hypotheses: the global hypotheses, the likeliest first; one with ``density: pmb``.
        weight: (G,) their probabilities.
    """

    hypotheses: tuple[FilterState, ...]
    weight: FloatArray

    @property
    def best(self) -> FilterState:
        """The likeliest global hypothesis."""
        return self.hypotheses[0]

    @property
    def track_ids(self) -> IntArray:
        """Ids of the tracks that some hypothesis has, active or inactive, ascending."""
        return np.unique(np.concatenate([h.all_track_ids for h in self.hypotheses]))

    @property
    def ue_mean(self) -> FloatArray:
        """(4,) mean of the vehicle's state over all hypotheses."""
        return _circular_mean(np.array([h.ue_mean for h in self.hypotheses]), self.weight)

    @property
    def ue_covariance(self) -> FloatArray:
        """(4, 4) its covariance: within the hypotheses and between them."""
        if len(self.hypotheses) == 1:
            return self.best.ue_covariance
        deviation = np.array([h.ue_mean for h in self.hypotheses]) - self.ue_mean
        deviation[:, HEADING] = wrap_angle(deviation[:, HEADING])
        within = np.array([h.ue_covariance for h in self.hypotheses])
        covariance = np.einsum("g,gij->ij", self.weight, within)
        return symmetrise(covariance + (deviation.T * self.weight) @ deviation)


def _circular_mean(states: FloatArray, weight: FloatArray) -> FloatArray:
    """(4,) weighted mean of states (G, 4), of the heading about that of the first."""
    deviation = states - states[0]
    deviation[:, HEADING] = wrap_angle(deviation[:, HEADING])
    mean = states[0] + weight @ deviation
    mean[HEADING] = wrap_angle(mean[HEADING])
    return np.asarray(mean)


@dataclass(frozen=True)
class MixtureStep:
    """The outcome of a step.

    Attributes:
        state: posterior density.
        associations: the hypotheses it came from, over all global ones before.
    """

    state: Mixture
    associations: Associations


def initial_mixture(parameters: FilterParameters) -> Mixture:
    """The density before the first snapshot."""
    return Mixture((initial_filter_state(parameters),), np.ones(1))


def landmarks_of(mixture: Mixture, parameters: FilterParameters) -> LandmarkEstimates:
    """The map to report: that of the likeliest global hypothesis."""
    return reported_landmarks(mixture.best, parameters)


def mixture_step(
    mixture: Mixture,
    measurements: MeasurementSet,
    spans: Sequence[ControlSpan],
    speed: float,
    parameters: FilterParameters,
) -> MixtureStep:
    """One step of the EK-PMB(M) filter: of the PMB, or of every global hypothesis of the PMBM.

    Each global hypothesis takes its own gamma best associations; of all of these the likeliest are
    carried on. A map that is known has one density only.

    Args:
        mixture: density after the previous snapshot.
        measurements: the snapshot.
        spans: controls since the previous snapshot; empty for the first one.
        speed: v at the snapshot [m/s].
        parameters: models and settings.
    """
    if parameters.density == "pmb" or not parameters.mapping:
        outcome = step(mixture.best, measurements, spans, speed, parameters)
        return MixtureStep(Mixture((outcome.state,), np.ones(1)), outcome.associations)
    observed, constants = prepare(measurements, parameters), parameters.constants
    predicted = [advance(hypothesis, spans, parameters) for hypothesis in mixture.hypotheses]
    found = [
        kernels.associate_paths(one.density, observed, float(speed), constants) for one in predicted
    ]
    numbered = np.any([one.born.kept for one in found], axis=0)
    conditioned = [
        condition_on(one.density, association, numbered, observed, constants)
        for one, association in zip(predicted, found, strict=True)
    ]
    if not all(one.definite for one in found) or not all(
        one.updated.definite for one in conditioned
    ):
        raise np.linalg.LinAlgError(NOT_POSITIVE)
    log_prior = np.log(mixture.weight) + [one.hypotheses.log_evidence for one in found]
    log_evidence = float(logsumexp(log_prior))
    prior = np.exp(log_prior - log_evidence)
    parts = [share * one.hypotheses.weight for share, one in zip(prior, found, strict=True)]
    weight = np.concatenate(parts)
    order = np.argsort(-weight, kind="stable")
    kept = [
        index
        for rank, index in enumerate(order[: parameters.hypotheses_kept].tolist())
        if rank == 0 or weight[index] > parameters.prune_hypothesis
    ]
    begin = np.cumsum([0, *map(len, parts)])
    states = []
    for index in kept:
        number = int(np.searchsorted(begin, index, side="right")) - 1
        alone = np.zeros(len(parts[number]))
        alone[index - begin[number]] = 1.0
        density, leaving = posterior(alone, conditioned[number], constants)
        state = FilterState(density, predicted[number].inactive)
        states.append(deactivate(state, parameters) if leaving else state)
    associations = _pooled(found, conditioned, observed, weight, log_evidence)
    return MixtureStep(Mixture(tuple(states), weight[kept] / weight[kept].sum()), associations)


def _pooled(
    found: Sequence[DataAssociation],
    conditioned: Sequence[Conditioned],
    observed: Observed,
    weight: FloatArray,
    log_evidence: float,
) -> Associations:
    """The associations of all global hypotheses together."""
    each = [
        kernels.by_landmark_id(
            one.density.track_id,
            association,
            one.birth_track,
            float(one.updated.nis[0]),
            observed,
        )
        for association, one in zip(found, conditioned, strict=True)
    ]
    born = np.max([one.born for one in each], axis=0)  # NONE is below every id
    # The likeliest of all is the likeliest of one of them.
    first = np.cumsum([0, *(len(one.weight) for one in each[:-1])])
    likeliest = each[int(np.argmax(weight[first]))]
    ids = np.concatenate([one.ids for one in each])
    return likeliest._replace(ids=ids, weight=weight, born=born, log_evidence=log_evidence)
