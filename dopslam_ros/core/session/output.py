"""What the filter says after a snapshot."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from dopslam_ros.core.models.measurements import MeasurementSet
from dopslam_ros.core.models.motion import Control
from dopslam_ros.core.monitoring.health import HEALTHY, Health
from dopslam_ros.core.pmb import (
    Associations,
    FilterParameters,
    LandmarkEstimates,
    Posterior,
    reported_landmarks,
)


@dataclass(frozen=True)
class FilterOutput:
    """What the filter says after a snapshot.

    Attributes:
        stamp_ns: time of the snapshot.
        state: posterior density.
        parameters: of the filter.
        control: what the vehicle does at that time; zeros if unknown.
        measurements: the paths that were used.
        associations: the hypotheses behind it, about these paths.
        step_seconds: time that the computation took.
        anew: whether the estimation begins with it: the first one, or the first after a reset.
        health: how the filter is after it.
    """

    stamp_ns: int
    state: Posterior
    parameters: FilterParameters
    control: Control
    measurements: MeasurementSet
    associations: Associations
    step_seconds: float
    anew: bool = False
    health: Health = HEALTHY

    @cached_property
    def landmarks(self) -> LandmarkEstimates:
        """The map to report; worked out when somebody asks, for it may be large."""
        return reported_landmarks(self.state, self.parameters)
