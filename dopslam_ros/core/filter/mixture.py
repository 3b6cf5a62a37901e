"""The PMBM density: several global hypotheses, each a PMB of its own; with one of them the PMB."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import logsumexp

from dopslam_ros.core.arrays import FloatArray, IntArray, symmetrise, wrap_angle
from dopslam_ros.core.filter import evidence, update
from dopslam_ros.core.filter.estimates import LandmarkEstimates, reported_landmarks
from dopslam_ros.core.filter.state import (
    FilterParameters,
    FilterState,
    initial_filter_state,
)
from dopslam_ros.core.filter.step import (
    Associations,
    Conditioned,
    Ranked,
    advance,
    associations_of,
    condition,
    finish,
    rank,
    step,
)
from dopslam_ros.core.measurements import MeasurementSet
from dopslam_ros.core.motion import ControlSpan


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
        """Ids of the tracks that some hypothesis has, awake or asleep, ascending."""
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
        deviation[:, 2] = wrap_angle(deviation[:, 2])
        within = np.array([h.ue_covariance for h in self.hypotheses])
        covariance = np.einsum("g,gij->ij", self.weight, within)
        return symmetrise(covariance + (deviation.T * self.weight) @ deviation)


def _circular_mean(states: FloatArray, weight: FloatArray) -> FloatArray:
    """(4,) weighted mean of states (G, 4), of the heading about that of the first."""
    deviation = states - states[0]
    deviation[:, 2] = wrap_angle(deviation[:, 2])
    mean = states[0] + weight @ deviation
    mean[2] = wrap_angle(mean[2])
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
    observed = evidence.prepare(measurements, parameters)
    ranked = [
        rank(advance(hypothesis, spans, parameters), observed, speed, parameters)
        for hypothesis in mixture.hypotheses
    ]
    numbered = np.any([one.born.kept for one in ranked], axis=0)
    conditioned = [condition(one, numbered, observed, parameters) for one in ranked]
    log_prior = np.log(mixture.weight) + [one.hypotheses.log_evidence for one in ranked]
    prior = np.exp(log_prior - logsumexp(log_prior))
    weight = np.concatenate(
        [share * one.hypotheses.weight for share, one in zip(prior, ranked, strict=True)]
    )
    states = [
        state
        for one in conditioned
        for state in update.separate(one.augmented, one.outcomes, parameters)
    ]
    order = np.argsort(-weight, kind="stable")
    kept = [
        index
        for rank_, index in enumerate(order[: parameters.hypotheses_kept].tolist())
        if rank_ == 0 or weight[index] > parameters.prune_hypothesis
    ]
    return MixtureStep(
        Mixture(
            tuple(finish(states[index], parameters) for index in kept),
            weight[kept] / weight[kept].sum(),
        ),
        _pooled(ranked, conditioned, weight, float(logsumexp(log_prior))),
    )


def _pooled(
    ranked: Sequence[Ranked],
    conditioned: Sequence[Conditioned],
    weight: FloatArray,
    log_evidence: float,
) -> Associations:
    """The associations of all global hypotheses together."""
    each = [associations_of(*pair) for pair in zip(ranked, conditioned, strict=True)]
    born = np.max([one.born for one in each], axis=0)  # UNASSIGNED is below every id
    # The likeliest of all is the likeliest of one of them.
    first = np.cumsum([0, *(len(one.weight) for one in each[:-1])])
    likeliest = each[int(np.argmax(weight[first]))]
    return replace(
        likeliest,
        ids=np.concatenate([one.ids for one in each]),
        weight=weight,
        born=born,
        log_evidence=log_evidence,
    )
