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
from dataclasses import replace

import numpy as np

from dopslam_ros.core.linalg.arrays import wrap_angle
from dopslam_ros.core.models.measurements import MeasurementSet
from dopslam_ros.core.models.motion import ControlSpan
from dopslam_ros.core.pmb.density import Density
from dopslam_ros.core.pmb.estimates import LandmarkEstimates
from dopslam_ros.core.pmb.observed import prepare
from dopslam_ros.core.pmb.posterior import initial_density
from dopslam_ros.core.pmb.undetected import looked_from
from dopslam_ros.core.settings.filtering import FilterParameters
from dopslam_ros.core.settings.layout import HEADING, LandmarkType, X, Y
from dopslam_ros.lab.baselines.births import propose
from dopslam_ros.lab.baselines.phd_map import heaviest, merge_near, updated_map
from dopslam_ros.lab.baselines.phd_state import PhdState
from dopslam_ros.lab.baselines.phd_vehicle import pairs_of, place_vehicle
from dopslam_ros.lab.baselines.prediction import predict


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
    moved = predict(state.ue_mean, state.ue_covariance, spans, parameters)
    state = replace(state, ue_mean=moved.mean, ue_covariance=moved.covariance)
    without_map = _without_map(state, parameters)
    observed = prepare(measurements, parameters)
    births = propose(without_map, observed, speed, parameters)
    pairs = pairs_of(state, observed, births, speed, parameters)
    vehicle = place_vehicle(state.ue_covariance, pairs, parameters.gamma)
    components = updated_map(state, pairs, vehicle, births, parameters)
    ue_mean = state.ue_mean + vehicle.shift
    ue_mean[HEADING] = wrap_angle(ue_mean[HEADING])
    return PhdState(
        ue_mean,
        vehicle.covariance,
        *heaviest(merge_near(components)),
        undetected=looked_from(
            state.undetected,
            float(ue_mean[X]),
            float(ue_mean[Y]),
            float(parameters.sp_field_of_view),
        ),
    )


def phd_landmarks(state: PhdState, parameters: FilterParameters) -> LandmarkEstimates:
    """The components that stand for a landmark of known position, as a GM-PHD filter reports them.

    A PHD has no labels: the ids are 1 ... L, the heaviest first, and mean nothing beyond the step.
    """
    std = np.sqrt(np.trace(state.covariances, axis1=1, axis2=2))
    shown = (state.weights >= parameters.report_existence) & (std <= parameters.report_std)
    types = state.types[shown]
    return LandmarkEstimates(
        ids=np.arange(1, len(types) + 1, dtype=np.int64),
        types=types,
        type_probabilities=np.eye(len(LandmarkType))[types],
        existence=np.minimum(state.weights[shown], 1.0),
        positions=state.means[shown],
        covariances=state.covariances[shown],
    )


def _without_map(state: PhdState, parameters: FilterParameters) -> Density:
    """Vehicle and undetected landmarks, which is what the births of the EK-PMB filter look at."""
    return initial_density(parameters).but(
        mean=state.ue_mean,
        covariance=state.ue_covariance,
        undetected=state.undetected,
    )
