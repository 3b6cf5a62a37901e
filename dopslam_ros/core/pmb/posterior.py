"""What the filter knows of vehicle and map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dopslam_ros.core.linalg.arrays import FloatArray, IntArray, floats, symmetrise, wrap_angle
from dopslam_ros.core.pmb.density import Density
from dopslam_ros.core.pmb.inactive_grid import InactiveGrid
from dopslam_ros.core.pmb.undetected import nothing_seen
from dopslam_ros.core.settings.filtering import FilterParameters
from dopslam_ros.core.settings.layout import ANGLES, HEADING, SPACE


@dataclass(frozen=True)
class Posterior:
    """p(s, X | Z_1:k), a mixture of PMB densities: one for each global hypothesis.

    Attributes:
        densities: of the vehicle and of all landmarks that may be detected from where it is, the
            likeliest hypothesis first; one with ``density: pmb``.
        inactive: of each hypothesis, the landmarks that are out of view.
        weight: (G,) probabilities of the hypotheses.
    """

    densities: tuple[Density, ...]
    inactive: tuple[InactiveGrid, ...]
    weight: FloatArray

    @property
    def density(self) -> Density:
        """That of the likeliest hypothesis."""
        return self.densities[0]

    @property
    def landmark_ids(self) -> IntArray:
        """Ids of the tracks of the likeliest hypothesis, active or inactive."""
        return all_ids(self.density, self.inactive[0])

    @property
    def track_ids(self) -> IntArray:
        """Ids of the tracks that some hypothesis has, active or inactive, ascending."""
        each = map(all_ids, self.densities, self.inactive)
        return np.unique(np.concatenate(list(each)))

    @property
    def ue_mean(self) -> FloatArray:
        """(U,) mean of the vehicle's state over all hypotheses."""
        return _circular_mean(np.array([one.ue_mean for one in self.densities]), self.weight)

    @property
    def ue_covariance(self) -> FloatArray:
        """(U, U) its covariance: within the hypotheses and between them."""
        if len(self.densities) == 1:
            return self.density.ue_covariance
        deviation = np.array([one.ue_mean for one in self.densities]) - self.ue_mean
        deviation[:, HEADING] = wrap_angle(deviation[:, HEADING])
        within = np.array([one.ue_covariance for one in self.densities])
        covariance = np.einsum("g,gij->ij", self.weight, within)
        return symmetrise(covariance + (deviation.T * self.weight) @ deviation)


def _circular_mean(states: FloatArray, weight: FloatArray) -> FloatArray:
    """(U,) weighted mean of states (G, U), of the heading about that of the first."""
    deviation = states - states[0]
    deviation[:, HEADING] = wrap_angle(deviation[:, HEADING])
    mean = states[0] + weight @ deviation
    mean[HEADING] = wrap_angle(mean[HEADING])
    return np.asarray(mean)


def all_ids(density: Density, inactive: InactiveGrid) -> IntArray:
    """Ids of all tracks of a hypothesis, active or inactive."""
    return np.concatenate([density.track_id, *(c.track_id for c in inactive.cells.values())])


def posterior_of(density: Density, inactive: InactiveGrid) -> Posterior:
    """That of one hypothesis."""
    return Posterior((density,), (inactive,), np.ones(1))


def initial_posterior(parameters: FilterParameters) -> Posterior:
    """The density before the first snapshot: the prior of the vehicle and an unknown map."""
    return posterior_of(initial_density(parameters), InactiveGrid())


def initial_density(parameters: FilterParameters) -> Density:
    """The prior of the vehicle, and no landmark."""
    none = np.zeros(0, dtype=np.int64)
    # Components beyond those that the models know are no angles.
    vehicle = ANGLES + (False,) * (len(parameters.initial_state) - len(ANGLES))
    return Density(
        mean=np.array(parameters.initial_state),
        covariance=floats(parameters.initial_covariance),
        vehicle=vehicle,
        start=np.array([len(vehicle)]),
        origin=np.zeros((0, SPACE)),
        axes=np.zeros((0, SPACE, SPACE)),
        component_track=none,
        component_type=none,
        component_weight=np.zeros(0),
        track_id=none,
        existence=np.zeros(0),
        undetected=nothing_seen(),
        next_id=1,
    )
