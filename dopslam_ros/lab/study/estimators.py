"""The filters that a study compares, behind one interface."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from dopslam_ros.core.linalg.arrays import FloatArray
from dopslam_ros.core.models.motion import Control, ControlSpan
from dopslam_ros.core.pmb import FilterParameters, LandmarkEstimates
from dopslam_ros.core.session.filtering import FilterSession
from dopslam_ros.core.settings.layout import SPACE, LandmarkType
from dopslam_ros.lab.baselines.genie import genie_landmarks, genie_step, initial_genie
from dopslam_ros.lab.baselines.phd import phd_landmarks, phd_step
from dopslam_ros.lab.baselines.phd_state import initial_phd
from dopslam_ros.lab.baselines.prediction import Gaussian, predict
from dopslam_ros.lab.study.source_tracker import SourceTracker
from dopslam_ros.simulation.scenario import Scenario
from dopslam_ros.simulation.simulator import Snapshot, all_landmarks


@dataclass(frozen=True)
class Estimate:
    """What a filter says after a snapshot.

    Attributes:
        mean: (U,) x [m], y [m], heading [rad], clock bias [m] of the vehicle.
        covariance: (U, U).
        landmarks: the map it reports.
        correct_weight: weight of the correct association; NaN for a filter that makes none.
        seconds: time the step took.
    """

    mean: FloatArray
    covariance: FloatArray
    landmarks: LandmarkEstimates
    correct_weight: float
    seconds: float


class Estimator(Protocol):
    """A filter on its way through one run."""

    def step(self, snapshot: Snapshot) -> Estimate:
        """Takes in the next snapshot.

        Raises:
            EstimatorError: there is no estimate.
        """


class EstimatorError(RuntimeError):
    """A filter that could not take a snapshot in."""


class SessionEstimator:
    """The EK-PMB or EK-PMBM filter, run as the node runs it."""

    def __init__(self, scenario: Scenario, parameters: FilterParameters) -> None:
        self._session = FilterSession(parameters)
        self._tracker = SourceTracker()

    def step(self, snapshot: Snapshot) -> Estimate:
        """Takes in the next snapshot."""
        known, stamp = self._session.state.track_ids, snapshot.stamp_ns
        control = snapshot.control
        outputs = [*self._session.add_control(stamp, control.speed, control.turn_rate)]
        outputs += self._session.add_measurements(stamp, snapshot.measurements)
        if not outputs:
            problems = ", ".join(sorted(self._session.problems))
            raise EstimatorError(f"no estimate at step {snapshot.step}: {problems}")
        (output,) = outputs
        return Estimate(
            output.state.ue_mean,
            output.state.ue_covariance,
            output.landmarks,
            self._tracker.correct_weight(snapshot, output.associations, known),
            output.step_seconds,
        )


class GenieEstimator:
    """The joint EKF that is told the true association."""

    def __init__(self, scenario: Scenario, parameters: FilterParameters) -> None:
        _, self._types = all_landmarks(scenario)
        self._parameters = parameters
        self._state = initial_genie(parameters)
        self._odometry = Odometry()

    def step(self, snapshot: Snapshot) -> Estimate:
        """Takes in the next snapshot."""
        started = time.perf_counter()
        self._state = genie_step(
            self._state,
            snapshot.measurements,
            snapshot.sources,
            self._types,
            self._odometry.spans(snapshot),
            snapshot.control.speed,
            self._parameters,
        )
        landmarks = genie_landmarks(self._state, self._types, self._parameters)
        seconds = time.perf_counter() - started
        vehicle = slice(self._state.vehicle)
        mean, covariance = self._state.mean[vehicle], self._state.covariance[vehicle, vehicle]
        return Estimate(mean, covariance, landmarks, math.nan, seconds)


class PhdEstimator:
    """The EK-PHD filter, whose map is an intensity."""

    def __init__(self, scenario: Scenario, parameters: FilterParameters) -> None:
        self._parameters = parameters
        self._state = initial_phd(parameters)
        self._odometry = Odometry()

    def step(self, snapshot: Snapshot) -> Estimate:
        """Takes in the next snapshot."""
        started = time.perf_counter()
        spans, speed = self._odometry.spans(snapshot), snapshot.control.speed
        self._state = state = phd_step(
            self._state, snapshot.measurements, spans, speed, self._parameters
        )
        landmarks = phd_landmarks(state, self._parameters)
        seconds = time.perf_counter() - started
        return Estimate(state.ue_mean, state.ue_covariance, landmarks, math.nan, seconds)


class DeadReckoning:
    """The controls alone: what the paths must improve on."""

    def __init__(self, scenario: Scenario, parameters: FilterParameters) -> None:
        self._parameters = parameters
        mean = np.array(parameters.initial_state)
        self._density = Gaussian(mean, parameters.initial_covariance)
        self._odometry = Odometry()

    def step(self, snapshot: Snapshot) -> Estimate:
        """Takes in the next snapshot."""
        started = time.perf_counter()
        spans = self._odometry.spans(snapshot)
        self._density = predict(*self._density, spans, self._parameters)
        seconds = time.perf_counter() - started
        return Estimate(*self._density, _NO_LANDMARKS, math.nan, seconds)


class Odometry:
    """What the vehicle did between two snapshots, for filters without a session."""

    def __init__(self) -> None:
        self._last: tuple[int, Control] | None = None

    def spans(self, snapshot: Snapshot) -> tuple[ControlSpan, ...]:
        """The control since the snapshot before; empty for the first one."""
        last, self._last = self._last, (snapshot.stamp_ns, snapshot.control)
        if last is None:
            return ()
        stamp, control = last
        return (ControlSpan(control, (snapshot.stamp_ns - stamp) * 1e-9),)


_NO_LANDMARKS = LandmarkEstimates(
    ids=np.zeros(0, dtype=np.int64),
    types=np.zeros(0, dtype=np.int64),
    type_probabilities=np.zeros((0, len(LandmarkType))),
    existence=np.zeros(0),
    positions=np.zeros((0, SPACE)),
    covariances=np.zeros((0, SPACE, SPACE)),
)
