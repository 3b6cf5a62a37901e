"""The filter and the bounds over time: inputs in any order go in, results in order come out.

The node and the offline replay run exactly these classes. They hold the state between calls and
count what was refused; all mathematics is in pure functions elsewhere.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from dopslam_ros.core.linalg.arrays import BoolArray, FloatArray, IntArray
from dopslam_ros.core.pcrb.bounds import Bounds, bounds_of, initial_bound, predict_bound, update_bound
from dopslam_ros.core.models.channel import DOPPLER, LandmarkType, observe
from dopslam_ros.core.pmb import Associations, FilterParameters, LandmarkEstimates, Mixture, landmarks_of
from dopslam_ros.core.monitoring.health import HEALTHY, Health
from dopslam_ros.core.linalg.gaussian import is_gaussian
from dopslam_ros.core.models.measurements import MeasurementSet
from dopslam_ros.core.settings.model import OnlineParameters, detection_probabilities, with_doppler_std
from dopslam_ros.core.models.motion import Control
from dopslam_ros.core.settings.parameters import parameter
from dopslam_ros.core.monitoring.recovery import watch_anew, watch_over, watched_step
from dopslam_ros.core.session.sequence import Sequencer, Timed
from dopslam_ros.core.session.control import SteeredFilter

_BS = int(LandmarkType.BS)
# Time began anew, and with it everything that was estimated.
BEGUN_ANEW = "reset_backward_jump"


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
    state: Mixture
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
        return landmarks_of(self.state, self.parameters)


class FilterSession(SteeredFilter):
    """The EK-PMB filter fed with measurement sets and controls.

    Attributes:
        problems: how often each kind of trouble was met while filtering.
    """

    def __init__(self, parameters: FilterParameters) -> None:
        super().__init__(parameters)
        self.problems: Counter[str] = Counter()
        self._watch = watch_over(self._state)

    @property
    def health(self) -> Health:
        """How the filter is."""
        return self._watch.health

    def add_control(self, stamp_ns: int, speed: float, turn_rate: float) -> Iterator[FilterOutput]:
        """A control; yields the results it was waited for.

        Raises:
            Refused: the control cannot be used.
        """
        self._sequencer.add_control(stamp_ns, speed, turn_rate)
        return self._process(self._sequencer.ready())

    def add_measurements(
        self, stamp_ns: int, measurements: MeasurementSet
    ) -> Iterator[FilterOutput]:
        """A measurement set; yields the results that are due.

        Raises:
            Refused: the set cannot be used.
        """
        self._pauses.check(stamp_ns, self._newest_ns)
        self._sequencer.add(stamp_ns, measurements)
        return self._process(self._sequencer.ready())

    def flush(self) -> Iterator[FilterOutput]:
        """Processes what still waits, as if no more inputs came."""
        return self._process(self._sequencer.flush())

    def end(self) -> Iterator[FilterOutput]:
        """Processes what still waits: no more inputs will come."""
        yield from self._process(self._sequencer.end())
        self.problems.update(self._sequencer.take_problems())

    def _process(self, due: Iterable[Timed[MeasurementSet]]) -> Iterator[FilterOutput]:
        for timed in due:
            if timed.anew:
                self.problems[BEGUN_ANEW] += 1
                self._begin_anew()
            self._do_scheduled(timed.stamp_ns)
            output = self._step(timed)
            self._last_ns = timed.stamp_ns
            if output is not None:
                yield output

    def _step(self, timed: Timed[MeasurementSet]) -> FilterOutput | None:
        started = time.perf_counter()
        self.problems.update(self._sequencer.take_problems())
        if not timed.complete:
            self.problems["missing_control"] += 1
        if not len(timed.item):
            self.problems["empty_set"] += 1
        known = timed.control is not None and not timed.stale
        measurements = timed.item if known else _without_doppler(timed.item)
        control = timed.control or Control(0.0, 0.0)
        # Owed until a step succeeds: whatever goes wrong below, the motion is not forgotten.
        anew, self._anew = self._anew, False
        self._owed = spans = () if anew else self._owed + timed.spans
        if self._watch.state is not self._state or anew:  # somebody has put in another
            self._watch = watch_anew(self._state, anew, self.parameters)
            self._state = self._watch.state
        try:
            watch, result = watched_step(
                self._watch, measurements, spans, control.speed, self.parameters
            )
        except np.linalg.LinAlgError:
            watch, result = self._watch, None
        if result is None or not _sound(result.state):
            self.problems["numerical_failure"] += 1
            return None  # the last good state stays
        self._owed = ()
        self._state, self._watch = result.state, watch
        return FilterOutput(
            stamp_ns=timed.stamp_ns,
            state=result.state,
            parameters=self.parameters,
            control=control,
            measurements=measurements,
            associations=result.associations,
            step_seconds=time.perf_counter() - started,
            anew=anew,
            health=watch.health,
        )


def _sound(state: Mixture) -> bool:
    return all(is_gaussian(one.density.mean, one.density.covariance) for one in state.hypotheses)


def _without_doppler(measurements: MeasurementSet) -> MeasurementSet:
    """Doppler says nothing while the speed is unknown."""
    values = measurements.values.copy()
    values[:, DOPPLER] = np.nan
    some = np.isfinite(values).any(axis=1)
    return MeasurementSet(values[some], measurements.covariances[some])


@dataclass(frozen=True)
class BoundsParameters(OnlineParameters):
    """Settings of the bounds beside the models."""

    source: str = parameter(
        "auto",
        "Where the bounds are evaluated: at the truth, at the filter's estimate, or auto: at the"
        " truth when somebody publishes it.",
        choices=("auto", "truth", "estimate"),
    )


@dataclass(frozen=True)
class WorldState:
    """Where vehicle and landmarks are, to evaluate the bounds at.

    Attributes:
        ue: (4,) state of the vehicle.
        ids: (M,) ids of the landmarks.
        types: (M,) LandmarkType; a BS among them or not.
        positions: (M, 3) [m].
        detected: (M,) which had a path, or how likely each was to have one, where that is known;
            None: p_D of the model, in expectation.
    """

    ue: FloatArray
    ids: IntArray
    types: IntArray
    positions: FloatArray
    detected: BoolArray | FloatArray | None = None


@dataclass(frozen=True)
class BoundsOutput:
    """Bounds after a snapshot.

    Attributes:
        stamp_ns: time of the snapshot.
        ids: (M,) landmarks, the BS not among them.
        types: (M,) LandmarkType.
        with_doppler: bounds with everything that is measured.
        without_doppler: the same less the Doppler.
    """

    stamp_ns: int
    ids: IntArray
    types: IntArray
    with_doppler: Bounds
    without_doppler: Bounds


class BoundsSession:
    """The recursion of the PIM fed with states and controls, with and without Doppler."""

    def __init__(self, parameters: BoundsParameters) -> None:
        self.parameters = parameters
        self.problems: Counter[str] = Counter()
        self._models = (parameters, with_doppler_std(parameters, None))
        self._sequencer: Sequencer[WorldState] = Sequencer(parameters)
        self._begin()

    def _begin(self) -> None:
        covariance = self.parameters.initial_covariance
        self._states = [initial_bound(covariance) for _ in self._models]
        self._ue: FloatArray | None = None

    @property
    def pending(self) -> int:
        """States that wait for their control."""
        return self._sequencer.pending

    def add_control(self, stamp_ns: int, speed: float, turn_rate: float) -> Iterator[BoundsOutput]:
        """A control; yields the bounds it was waited for. Raises Refused."""
        self._sequencer.add_control(stamp_ns, speed, turn_rate)
        return map(self._step, self._sequencer.ready())

    def add_world(self, stamp_ns: int, world: WorldState) -> Iterator[BoundsOutput]:
        """The state at a snapshot; yields the bounds that are due. Raises Refused."""
        self._sequencer.add(stamp_ns, world)
        return map(self._step, self._sequencer.ready())

    def end(self) -> Iterator[BoundsOutput]:
        """Processes what still waits: no more inputs will come."""
        yield from map(self._step, self._sequencer.end())
        self.problems.update(self._sequencer.take_problems())

    def _step(self, timed: Timed[WorldState]) -> BoundsOutput:
        self.problems.update(self._sequencer.take_problems())
        if not timed.complete:
            self.problems["missing_control"] += 1
        if timed.anew:
            self.problems[BEGUN_ANEW] += 1
            self._begin()
        world, model = timed.item, self.parameters
        # The BS takes part once, whether or not the map lists it.
        listed = world.types != _BS
        ids = np.concatenate(([-1], world.ids[listed]))
        types = np.concatenate(([_BS], world.types[listed]))
        positions = np.concatenate((model.bs[None], world.positions[listed]))
        speed = timed.control.speed if timed.control else 0.0
        paths = observe(world.ue, speed, positions, types, model.bs, model.ue_height)
        if world.detected is None:
            ue = np.array([world.ue[0], world.ue[1], model.ue_height])
            chance = detection_probabilities(model, ue, positions, types) * paths.facing
        else:
            of_bs = world.detected[~listed].max(initial=0)
            chance = np.concatenate(([of_bs], world.detected[listed]))

        results, is_bs = [], ids == -1
        for number, variant in enumerate(self._models):
            state = self._states[number]
            if self._ue is not None:
                state = predict_bound(state, self._ue, timed.spans, variant.noise_rate)
            used = variant.used_components
            if timed.control is None or timed.stale:
                used = used & (np.arange(len(used)) != DOPPLER)
            state = update_bound(state, paths, ids, is_bs, chance, variant.noise, used)
            self._states[number] = state
            results.append(bounds_of(state, ids[1:]))
        self._ue = world.ue
        return BoundsOutput(timed.stamp_ns, ids[1:], types[1:], results[0], results[1])
