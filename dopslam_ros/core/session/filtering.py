"""The filter over time: inputs in any order go in, results in order come out.

The node and the offline replay run exactly these classes. They hold the state between calls and
count what was refused; all mathematics is in pure functions elsewhere.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterable, Iterator

import numpy as np

from dopslam_ros.core.linalg.gaussian import is_gaussian
from dopslam_ros.core.models.measurements import MeasurementSet
from dopslam_ros.core.models.motion import Control
from dopslam_ros.core.monitoring.health import Health
from dopslam_ros.core.monitoring.recovery import monitor_anew, monitor_of, monitored_step
from dopslam_ros.core.pmb import Associations, FilterParameters, Posterior, prepare
from dopslam_ros.core.session.control import ControlledFilter
from dopslam_ros.core.session.output import FilterOutput
from dopslam_ros.core.session.sequence import BEGUN_ANEW, Timed
from dopslam_ros.core.settings.layout import DOPPLER


class FilterSession(ControlledFilter):
    """The EK-PMB filter fed with measurement sets and controls.

    Attributes:
        problems: how often each kind of problem was met while filtering.
    """

    def __init__(self, parameters: FilterParameters) -> None:
        super().__init__(parameters)
        self.problems: Counter[str] = Counter()
        self._monitor = monitor_of(self._state)

    @property
    def health(self) -> Health:
        """How the filter is."""
        return self._monitor.health

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
        self._count_problems(timed)
        known = timed.control is not None and not timed.stale
        measurements = timed.item if known else _without_doppler(timed.item)
        control = timed.control or Control(0.0, 0.0)
        # Owed until a step succeeds: whatever goes wrong below, the motion is not forgotten.
        anew, self._anew = self._anew, False
        self._owed = () if anew else self._owed + timed.spans
        associations = self._take_in(measurements, control.speed, anew)
        if associations is None:
            self.problems["numerical_failure"] += 1
            return None  # the last good state stays
        self._owed = ()
        return FilterOutput(
            stamp_ns=timed.stamp_ns,
            state=self._state,
            parameters=self.parameters,
            control=control,
            measurements=measurements,
            associations=associations,
            step_seconds=time.perf_counter() - started,
            anew=anew,
            health=self.health,
        )

    def _count_problems(self, timed: Timed[MeasurementSet]) -> None:
        self.problems.update(self._sequencer.take_problems())
        if not timed.complete:
            self.problems["missing_control"] += 1
        if not len(timed.item):
            self.problems["empty_set"] += 1

    def _take_in(
        self, measurements: MeasurementSet, speed: float, anew: bool
    ) -> Associations | None:
        """The state after a set, and the associations behind it; None: there is no good one."""
        if self._monitor.state is not self._state or anew:  # somebody has put in another
            self._monitor = monitor_anew(self._state, anew, self.parameters)
            self._state = self._monitor.state
        observed = prepare(measurements, self.parameters)
        try:
            monitor, associations = monitored_step(
                self._monitor, observed, self._owed, speed, self.parameters
            )
        except np.linalg.LinAlgError:
            return None
        if not _is_gaussian(monitor.state):
            return None
        self._state, self._monitor = monitor.state, monitor
        return associations


def _is_gaussian(state: Posterior) -> bool:
    return all(is_gaussian(one.mean, one.covariance, len(one.vehicle)) for one in state.densities)


def _without_doppler(measurements: MeasurementSet) -> MeasurementSet:
    """Doppler says nothing while the speed is unknown."""
    values = measurements.values.copy()
    values[:, DOPPLER] = np.nan
    some = np.isfinite(values).any(axis=1)
    return MeasurementSet(
        values[some], measurements.covariances[some], measurements.base_station[some]
    )
