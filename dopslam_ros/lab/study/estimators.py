"""The filters that a study compares, behind one interface."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from dopslam_ros.core.linalg.arrays import FloatArray, IntArray
from dopslam_ros.core.models.motion import Control, ControlSpan, predict_covariance, propagate_spans
from dopslam_ros.core.pmb import Associations, FilterParameters, LandmarkEstimates
from dopslam_ros.core.session.filtering import FilterSession
from dopslam_ros.core.settings.layout import BS_ID, NONE, UE, LandmarkType
from dopslam_ros.core.settings.parameters import (
    ParameterError,
    checked_values,
    parse_assignments,
    unknown_name,
)
from dopslam_ros.lab.baselines.genie import genie_landmarks, genie_step, initial_genie
from dopslam_ros.lab.baselines.phd import initial_phd, phd_landmarks, phd_step
from dopslam_ros.simulation.matched import filter_parameters_for
from dopslam_ros.simulation.scenario import Scenario
from dopslam_ros.simulation.simulator import Snapshot, all_landmarks


@dataclass(frozen=True)
class Estimate:
    """What a filter says after a snapshot.

    Attributes:
        mean: (4,) x [m], y [m], heading [rad], clock bias [m] of the vehicle.
        covariance: (4, 4).
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


class Kind(NamedTuple):
    """A filter that can be studied, one of ``names.FILTERS``.

    Attributes:
        fixed: the settings that make it what its name says.
        make: from the scene and the filter's parameters.
    """

    fixed: Mapping[str, object]
    make: Callable[[Scenario, FilterParameters], Estimator]


def make_estimator(label: str, scenario: Scenario, settings: Mapping[str, object]) -> Estimator:
    """The filter that a label names, knowing the models of the scene.

    Args:
        label: a name of KINDS, or with settings of its own, as in ``joint:gamma=20``.
        scenario: the scene, with the Doppler noise of the run.
        settings: of all filters; those of the label come first.

    Raises:
        ParameterError: unknown name, or a value that cannot be used.
    """
    kind, own = parse_label(label)
    _refuse_contradiction(label, kind, settings)
    values = {**settings, **own, **kind.fixed}
    return kind.make(scenario, filter_parameters_for(scenario, **values))


def check_label(label: str, settings: Mapping[str, object]) -> None:
    """Raises ParameterError if ``make_estimator`` would."""
    kind, _ = parse_label(label)
    _refuse_contradiction(label, kind, settings)


def parse_label(label: str) -> tuple[Kind, dict[str, object]]:
    """The filter that a label names and the settings it gives it.

    Raises:
        ParameterError: unknown name, or a value that cannot be used.
    """
    name, colon, text = label.partition(":")
    if name not in KINDS:
        raise ParameterError(unknown_name("filter", name, KINDS))
    try:
        values: dict[str, object] = {
            **checked_values(FilterParameters, parse_assignments(text) if colon else {})
        }
    except ParameterError as error:
        raise ParameterError(f"filter '{label}': {error}") from error
    _refuse_contradiction(label, KINDS[name], values)
    return KINDS[name], values


def _refuse_contradiction(label: str, kind: Kind, settings: Mapping[str, object]) -> None:
    for name, value in kind.fixed.items():
        if settings.get(name, value) != value:
            raise ParameterError(
                f"filter '{label}' has {name} = {value}, not {settings[name]}: leave the setting"
                f" out, or name another filter ({', '.join(KINDS)})"
            )


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
        mean, covariance = self._state.mean[:UE], self._state.covariance[:UE, :UE]
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
        self._noise_rate = parameters.noise_rate
        self._mean = np.array(parameters.initial_state)
        self._covariance = parameters.initial_covariance
        self._odometry = Odometry()

    def step(self, snapshot: Snapshot) -> Estimate:
        """Takes in the next snapshot."""
        started = time.perf_counter()
        spans = self._odometry.spans(snapshot)
        self._mean, jacobian, noise = propagate_spans(self._mean, spans, self._noise_rate)
        self._covariance = predict_covariance(self._covariance, jacobian, noise)
        return Estimate(
            self._mean,
            self._covariance,
            _NO_LANDMARKS,
            math.nan,
            time.perf_counter() - started,
        )


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


class SourceTracker:
    """Remembers which track stands for which true landmark: the one that got most of its paths.

    What counts is the weight with which each path was given to a track, or gave birth to it.
    """

    def __init__(self) -> None:
        self._fed: dict[tuple[int, int], float] = {}

    def correct_weight(
        self, snapshot: Snapshot, associations: Associations, known: IntArray
    ) -> float:
        """Weight, among the hypotheses kept, of the association that is true.

        Args:
            snapshot: with the true sources.
            associations: of the filter at this snapshot.
            known: ids of the tracks before the snapshot.
        """
        owners = self._owners(set(known.tolist()))
        true = [owners.get(source, NONE) for source in snapshot.sources.tolist()]
        right = (associations.ids == np.array(true, dtype=np.int64)).all(axis=1)
        for path, source in enumerate(snapshot.sources.tolist()):
            if source > 0:
                born = int(associations.born[path])
                for track, weight in zip(
                    associations.ids[:, path].tolist(), associations.weight.tolist(), strict=True
                ):
                    key = (source, born if track == NONE else track)
                    self._fed[key] = self._fed.get(key, 0.0) + weight
        return float(associations.weight[right].sum())

    def _owners(self, alive: set[int]) -> dict[int, int]:
        """The track of each source, 0 being the BS; of a track that was fed by two, the first."""
        self._fed = {key: fed for key, fed in self._fed.items() if key[1] in alive}
        owners = {0: BS_ID}
        taken = set()
        for source, track in sorted(self._fed, key=lambda key: (-self._fed[key], key)):
            if source not in owners and track not in taken:
                owners[source] = track
                taken.add(track)
        return owners


_NO_LANDMARKS = LandmarkEstimates(
    ids=np.zeros(0, dtype=np.int64),
    types=np.zeros(0, dtype=np.int64),
    type_probabilities=np.zeros((0, len(LandmarkType))),
    existence=np.zeros(0),
    positions=np.zeros((0, 3)),
    covariances=np.zeros((0, 3, 3)),
)

KINDS: dict[str, Kind] = {
    "joint": Kind(
        {"coupling": "joint", "density": "pmb"},
        SessionEstimator,
    ),
    "marginal": Kind(
        {"coupling": "marginal", "density": "pmb"},
        SessionEstimator,
    ),
    "pmbm": Kind(
        {"density": "pmbm"},
        SessionEstimator,
    ),
    "phd": Kind({}, PhdEstimator),
    "genie": Kind({}, GenieEstimator),
    "dead_reckoning": Kind({}, DeadReckoning),
}
