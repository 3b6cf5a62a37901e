"""The step of the PMBM density: several global hypotheses, each a PMB of its own."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import logsumexp

from dopslam_ros.core.linalg.arrays import FloatArray
from dopslam_ros.core.pmb import pmbm_kernels as kernels
from dopslam_ros.core.pmb.inactive import deactivate
from dopslam_ros.core.pmb.likelihood import Observed
from dopslam_ros.core.pmb.merge import Conditioned
from dopslam_ros.core.pmb.posterior import Posterior
from dopslam_ros.core.pmb.step_kernels import Associations, DataAssociation, condition_on, posterior
from dopslam_ros.core.settings.filtering import FilterParameters


def update_hypotheses(
    predicted: Posterior, observed: Observed, speed: float, parameters: FilterParameters
) -> tuple[Posterior, Associations]:
    """Each global hypothesis takes its own gamma best associations; the likeliest are carried on.

    Args:
        predicted: the density that the set is weighed against.
        observed: the set.
        speed: v at the snapshot [m/s].
        parameters: models and settings.

    Returns:
        The posterior, and the associations it came from, over all global hypotheses before.

    Raises:
        LinAlgError: an innovation's covariance is not positive definite.
    """
    constants = parameters.constants
    found = [
        kernels.associate_paths(one, observed, float(speed), constants)
        for one in predicted.densities
    ]
    numbered = np.any([one.born.kept for one in found], axis=0)
    conditioned = [
        condition_on(one, association, numbered, observed, constants)
        for one, association in zip(predicted.densities, found, strict=True)
    ]
    definite = [one.definite for one in found] + [one.updated.definite for one in conditioned]
    if not all(definite):
        raise np.linalg.LinAlgError("an innovation's covariance is not positive definite")
    log_prior = np.log(predicted.weight) + [one.hypotheses.log_evidence for one in found]
    log_evidence = float(logsumexp(log_prior))
    prior = np.exp(log_prior - log_evidence)
    weights = [share * one.hypotheses.weight for share, one in zip(prior, found, strict=True)]
    state = _likeliest(predicted, conditioned, weights, parameters)
    weight = np.concatenate(weights)
    return state, _pooled(found, conditioned, observed, weight, log_evidence)


def _likeliest(
    predicted: Posterior,
    conditioned: Sequence[Conditioned],
    weights: Sequence[FloatArray],
    parameters: FilterParameters,
) -> Posterior:
    """The global hypotheses that are carried on.

    Args:
        predicted: the hypotheses before.
        conditioned: each under its associations.
        weights: of these, over all hypotheses together.
        parameters: how many are kept, and how likely they must be.
    """
    weight = np.concatenate(weights)
    order = np.argsort(-weight, kind="stable")[: parameters.hypotheses_kept].tolist()
    kept = [order[0], *(i for i in order[1:] if weight[i] > parameters.prune_hypothesis)]
    begin = np.cumsum([0, *map(len, weights)])
    densities, grids = [], []
    for index in kept:
        number = int(np.searchsorted(begin, index, side="right")) - 1
        alone = np.zeros(len(weights[number]))
        alone[index - begin[number]] = 1.0
        density, leaving = posterior(alone, conditioned[number], parameters.constants)
        inactive = predicted.inactive[number]
        if leaving:
            density, inactive = deactivate(density, inactive, parameters)
        densities.append(density)
        grids.append(inactive)
    return Posterior(tuple(densities), tuple(grids), weight[kept] / weight[kept].sum())


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
