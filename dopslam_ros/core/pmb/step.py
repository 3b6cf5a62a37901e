"""One step of the EK-PMB filter: predict, weigh, associate, update, merge, prune."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dopslam_ros.core.models.measurements import MeasurementSet
from dopslam_ros.core.models.motion import ControlSpan, span_rows
from dopslam_ros.core.models.motion import predict as predict_arrays
from dopslam_ros.core.pmb.inactive import deactivate, reactivate
from dopslam_ros.core.pmb.likelihood import Observed
from dopslam_ros.core.pmb.localisation import localise
from dopslam_ros.core.pmb.observed import prepare
from dopslam_ros.core.pmb.state import FilterState
from dopslam_ros.core.pmb.step_kernels import Associations, slam
from dopslam_ros.core.settings.filtering import FilterParameters

NOT_POSITIVE = "an innovation's covariance is not positive definite"


@dataclass(frozen=True)
class Step:
    """The outcome of a step.

    Attributes:
        state: posterior density.
        associations: the hypotheses it was merged from.
    """

    state: FilterState
    associations: Associations


def step(
    state: FilterState,
    measurements: MeasurementSet,
    spans: Sequence[ControlSpan],
    speed: float,
    parameters: FilterParameters,
) -> Step:
    """p(s, X | Z_1:k-1) to p(s, X | Z_1:k), eq. (30).

    Args:
        state: density after the previous snapshot.
        measurements: the snapshot.
        spans: controls since the previous snapshot; empty for the first one.
        speed: v at the snapshot [m/s].
        parameters: models and settings.

    Raises:
        LinAlgError: an innovation's covariance is not positive definite.
    """
    predicted = advance(state, spans, parameters)
    observed = prepare(measurements, parameters)
    return update(predicted, predicted, observed, speed, parameters)


def update(
    weighed: FilterState,
    prior: FilterState,
    observed: Observed,
    speed: float,
    parameters: FilterParameters,
    births: bool = True,
) -> Step:
    """The part of a step that the paths have a say in.

    Args:
        weighed: the predicted density that says how the paths may go, and where to linearise.
        prior: the one that is updated: the same, or one with the vehicle somewhere else.
        observed: the paths.
        speed: v at the snapshot [m/s].
        parameters: models and settings.
        births: whether there may be new landmarks.

    Raises:
        LinAlgError: an innovation's covariance is not positive definite.
    """
    before, after, constants = weighed.density, prior.density, parameters.constants
    if parameters.mapping:
        outcome = slam(before, after, births, observed, float(speed), constants)
    else:
        outcome = localise(before, after, observed, float(speed), constants)
    if not outcome.definite:
        raise np.linalg.LinAlgError(NOT_POSITIVE)
    state = FilterState(outcome.density, prior.inactive)
    if outcome.leaving:
        state = deactivate(state, parameters)
    return Step(state, outcome.associations)


def advance(
    state: FilterState, spans: Sequence[ControlSpan], parameters: FilterParameters
) -> FilterState:
    """The density that the next set is weighed against: predicted, what may be seen active."""
    return reactivate(predict(state, spans, parameters), parameters)


def predict(
    state: FilterState, spans: Sequence[ControlSpan], parameters: FilterParameters
) -> FilterState:
    """The vehicle moves by f with F P F' + Q; the map is static, its correlation follows F.

    The prediction below eq. (30).
    """
    if not spans:
        return state
    before = state.density
    mean, covariance = predict_arrays(
        before.mean, before.covariance, span_rows(spans), parameters.noise_rate
    )
    return FilterState(before._replace(mean=mean, covariance=covariance), state.inactive)
