"""The step on a known map: only the vehicle is estimated, the map stays as it is.

The map is uncertain nevertheless, and the vehicle's error is correlated with the map's. So the
update is that of Schmidt's consider filter, with the gain K for the vehicle and none for the map:

    P_ss <- P_ss - K S K',   P_sm <- P_sm - K H P_m,   P_mm as it was.

K being the vehicle's rows of P H' S^-1, these are the vehicle's rows of the ordinary joint update.
"""

from __future__ import annotations

import numpy as np

from dopslam_ros.core.linalg.arrays import FloatArray
from dopslam_ros.core.linalg.jit import from_python, jit_inline
from dopslam_ros.core.models.channel_kernels import wrapped
from dopslam_ros.core.pmb.density import Density
from dopslam_ros.core.pmb.inactive_kernels import some_left_behind
from dopslam_ros.core.pmb.likelihood import Observed
from dopslam_ros.core.pmb.merge_gaussian import uncouple
from dopslam_ros.core.pmb.step_kernels import Outcome, associate_paths, by_landmark_id
from dopslam_ros.core.pmb.update import Linearised, Updated, condition
from dopslam_ros.core.settings.filtering import Constants
from dopslam_ros.core.settings.layout import HEADING, NONE


@from_python
def localise(
    weighed: Density, prior: Density, observed: Observed, speed: float, constants: Constants
) -> Outcome:
    """The step on a known map; paths that are not of it are of no interest.

    Args:
        weighed: the predicted density that says how the paths may go, and where to linearise.
        prior: the one that is updated: the same, or one with the vehicle somewhere else.
        observed: the paths.
        speed: v at the snapshot [m/s].
        constants: of the filter.
    """
    association = associate_paths(weighed, observed, speed, constants)
    best = association.hypotheses
    about = Linearised(prior.mean, prior.vehicle, prior.start, association.likelihoods, observed)
    updated = condition(about, prior.covariance, best.source)
    after = consider(prior, updated, best.weight, constants.joint)
    unborn = np.full(len(observed.values), NONE)
    named = by_landmark_id(prior.track_id, association, unborn, updated.nis[0], observed)
    leaving = some_left_behind(after, constants.sp_field_of_view)
    return Outcome(after, leaving, named, association.definite and updated.definite)


@jit_inline
def consider(density: Density, updated: Updated, weight: FloatArray, joint: bool) -> Density:
    """The density after a snapshot, moments matched over the hypotheses; the map is untouched.

    Args:
        density: the paths were weighed against.
        updated: the joint update under each hypothesis.
        weight: (H,) of the hypotheses, normalised.
        joint: whether correlations are kept.
    """
    n, vehicle = len(density.mean), density.start[0]
    mean, covariance = density.mean.copy(), density.covariance.copy()
    for i in range(vehicle):
        mean[i] = 0.0
    shares = np.empty(len(weight))
    for h in range(len(weight)):
        shares[updated.rank[h]] = weight[h]
        for i in range(vehicle):
            mean[i] += weight[h] * updated.means[h, i]
    for i in range(vehicle):
        row = updated.covariance[i].copy()
        for branch in range(len(updated.gains)):
            share, gain = 0.0, updated.gains[branch]
            for at in range(updated.first[branch], updated.last[branch]):
                share += shares[at]
            for k in range(len(gain)):
                factor = share * gain[k, i]
                for j in range(n):
                    row[j] -= factor * gain[k, j]
        for h in range(len(weight)):
            for j in range(vehicle):
                off = (updated.means[h, i] - mean[i]) * (updated.means[h, j] - mean[j])
                row[j] += weight[h] * off
        for j in range(i, n):
            covariance[i, j] = row[j]
            covariance[j, i] = row[j]
    mean[HEADING] = wrapped(mean[HEADING])
    if not joint:
        uncouple(covariance, density.start)
    return Density(
        mean,
        covariance,
        density.vehicle,
        density.start,
        density.origin,
        density.axes,
        density.component_track,
        density.component_type,
        density.component_weight,
        density.track_id,
        density.existence,
        density.undetected,
        density.next_id,
    )
