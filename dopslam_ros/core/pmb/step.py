"""One step of the EK-PMB(M) filter: predict, weigh, associate, update, merge, prune."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dopslam_ros.core.models.motion import ControlSpan, span_rows
from dopslam_ros.core.models.motion import predict as predict_arrays
from dopslam_ros.core.pmb.density import Density
from dopslam_ros.core.pmb.inactive import deactivate, reactivate
from dopslam_ros.core.pmb.inactive_grid import InactiveGrid
from dopslam_ros.core.pmb.likelihood import Observed
from dopslam_ros.core.pmb.localisation import localise
from dopslam_ros.core.pmb.pmbm import update_hypotheses
from dopslam_ros.core.pmb.posterior import Posterior, posterior_of
from dopslam_ros.core.pmb.step_kernels import Associations, slam
from dopslam_ros.core.settings.filtering import FilterParameters


def step(
    state: Posterior,
    observed: Observed,
    spans: Sequence[ControlSpan],
    speed: float,
    parameters: FilterParameters,
) -> tuple[Posterior, Associations]:
    """p(s, X | Z_1:k-1) to p(s, X | Z_1:k), eq. (30); a map that is known has one density only.

    Args:
        state: density after the previous snapshot.
        observed: the snapshot.
        spans: controls since the previous snapshot; empty for the first one.
        speed: v at the snapshot [m/s].
        parameters: models and settings.

    Returns:
        The posterior, and the associations it came from.

    Raises:
        LinAlgError: an innovation's covariance is not positive definite.
    """
    predicted = advance(state, spans, parameters)
    if parameters.density == "pmbm" and parameters.mapping:
        return update_hypotheses(predicted, observed, speed, parameters)
    density, inactive = predicted.density, predicted.inactive[0]
    return update(density, density, inactive, observed, speed, parameters)


def advance(
    state: Posterior, spans: Sequence[ControlSpan], parameters: FilterParameters
) -> Posterior:
    """The density that the next set is weighed against: predicted, what may be seen active."""
    moved = predict(state, spans, parameters)
    pairs = [
        reactivate(density, inactive, parameters)
        for density, inactive in zip(moved.densities, moved.inactive, strict=True)
    ]
    densities, grids = zip(*pairs, strict=True)
    return Posterior(densities, grids, state.weight)


def predict(
    state: Posterior, spans: Sequence[ControlSpan], parameters: FilterParameters
) -> Posterior:
    """The vehicle moves by f with F P F' + Q; the map is static, its correlation follows F.

    The prediction below eq. (30).
    """
    if not spans:
        return state
    rows, moved = span_rows(spans), []
    for one in state.densities:
        mean, covariance = predict_arrays(one.mean, one.covariance, rows, parameters.noise_rate)
        moved.append(one._replace(mean=mean, covariance=covariance))
    return replace(state, densities=tuple(moved))


def update(
    weighed: Density,
    prior: Density,
    inactive: InactiveGrid,
    observed: Observed,
    speed: float,
    parameters: FilterParameters,
    births: bool = True,
) -> tuple[Posterior, Associations]:
    """The part of a step that the paths have a say in, of one hypothesis.

    Args:
        weighed: the predicted density that says how the paths may go, and where to linearise.
        prior: the one that is updated: the same, or one with the vehicle somewhere else.
        inactive: the landmarks out of view.
        observed: the paths.
        speed: v at the snapshot [m/s].
        parameters: models and settings.
        births: whether there may be new landmarks.

    Raises:
        LinAlgError: an innovation's covariance is not positive definite.
    """
    constants = parameters.constants
    if parameters.mapping:
        outcome = slam(weighed, prior, births, observed, float(speed), constants)
    else:
        outcome = localise(weighed, prior, observed, float(speed), constants)
    if not outcome.definite:
        raise np.linalg.LinAlgError("an innovation's covariance is not positive definite")
    density = outcome.density
    if outcome.leaving:
        density, inactive = deactivate(density, inactive, parameters)
    return posterior_of(density, inactive), outcome.associations
