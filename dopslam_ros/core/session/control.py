"""The filter between two sets: what it remembers, and what may be done to it from outside."""

from __future__ import annotations

from collections import deque

from dopslam_ros.core.models.measurements import MeasurementSet
from dopslam_ros.core.models.motion import ControlSpan
from dopslam_ros.core.pmb import FilterParameters, Posterior, initial_posterior
from dopslam_ros.core.session.checkpoint import (
    BEFORE_ALL,
    MAP,
    SNAPSHOT,
    Checkpoint,
    in_map,
    map_checkpoint,
)
from dopslam_ros.core.session.events import CONTINUE, LOAD_MAP, PAUSE, RESET, RESUME, Event, Pauses
from dopslam_ros.core.session.sequence import Sequencer
from dopslam_ros.core.settings.parameters import shared_values


class ControlledFilter:
    """Density, order of the sets, and the events that change them.

    Each method that changes something returns the event, for those who record the run; ``schedule``
    makes the same happen in a replay.
    """

    def __init__(self, parameters: FilterParameters) -> None:
        self.parameters = parameters
        self._settings = shared_values(parameters, FilterParameters)
        self._sequencer: Sequencer[MeasurementSet] = Sequencer(parameters)
        self._state = initial_posterior(parameters)
        self._owed: tuple[ControlSpan, ...] = ()
        self._last_ns = BEFORE_ALL
        self._anew = True  # the next set is like a first one: no motion leads to it
        self._start_map: Checkpoint | None = None
        self._known_map = self._learned_map()
        self._pauses = Pauses()
        self._scheduled: deque[Event] = deque()

    @property
    def state(self) -> Posterior:
        """The density after the last snapshot processed."""
        return self._state

    @property
    def pending(self) -> int:
        """Sets that wait for their control."""
        return self._sequencer.pending

    def reset(self) -> Event:
        """Back to the initial state, in the map loaded before the first set if there was one."""
        return self._do(Event(RESET, self._last_ns))

    def replace_map(self, saved: Checkpoint) -> Event:
        """Takes a map in the place of the present one; the vehicle stays where it is.

        Its correlation with the map is dropped: the map must not come from this very run.

        Raises:
            CheckpointError: it is no map, or one of a filter that was set otherwise.
        """
        saved.check(MAP, self.parameters)
        return self._do(Event(LOAD_MAP, self._last_ns, saved=saved))

    def restore(self, saved: Checkpoint) -> Event:
        """Goes on as the filter that made a snapshot; nothing may have been added yet.

        Raises:
            CheckpointError: it is no snapshot, or one of a filter that was set otherwise.
        """
        saved.check(SNAPSHOT, self.parameters)
        return self._do(Event(RESUME, self._last_ns, saved=saved))

    def pause(self) -> Event:
        """Sets newer than those taken so far are refused; controls are taken.

        Not to be called while ``paused``.
        """
        return self._pauses.begin(self._newest_ns)

    def go_on(self) -> Event:
        """The end of a pause: the next set is predicted to, over all of the time between.

        Only to be called while ``paused``.
        """
        return self._pauses.end()

    @property
    def paused(self) -> bool:
        """Whether sets are refused."""
        return self._pauses.now

    def schedule(self, event: Event) -> None:
        """An event of a recorded run, in the order they happened; it takes effect in its turn."""
        if event.kind == PAUSE:
            self._pauses.begin(event.after_ns)
        elif event.kind == CONTINUE and self.paused:
            self._pauses.end(event.until_ns)
        elif event.kind != CONTINUE:
            if event.saved is not None:
                event.saved.check(MAP if event.kind == LOAD_MAP else SNAPSHOT, self.parameters)
            self._scheduled.append(event)
            self._do_scheduled(before_ns=self._last_ns + 1)

    def snapshot(self) -> Checkpoint:
        """All that ``restore`` needs to go on after the last set processed."""
        return Checkpoint(
            SNAPSHOT,
            BEFORE_ALL if self._anew else self._last_ns,
            self._settings,
            self._state,
            self._sequencer.controls,
            self._owed,
            None if self.parameters.mapping else self._known_map,
        )

    def known_map(self) -> Checkpoint:
        """The map: as it is by now or, where none is learned, as it was loaded."""
        return self._learned_map() if self.parameters.mapping else self._known_map

    @property
    def _newest_ns(self) -> int:
        newest = self._sequencer.newest_ns
        return BEFORE_ALL if newest is None else newest

    def _learned_map(self) -> Checkpoint:
        return map_checkpoint(self._state, self._last_ns, self._settings)

    def _do(self, event: Event) -> Event:
        saved = event.saved
        if event.kind == RESET:
            self._state, self._owed, self._anew = initial_posterior(self.parameters), (), True
            saved = self._start_map
            if saved is None:
                self._known_map = self._learned_map()
        elif event.kind == LOAD_MAP and self._last_ns == BEFORE_ALL:
            self._start_map = saved
        if saved is not None and saved.kind == SNAPSHOT:
            self._go_on_from(saved)
        elif saved is not None:
            self._known_map = saved
            self._state = in_map(self._state, saved, self.parameters)
        return event

    def _begin_anew(self) -> None:
        """Time has begun anew: as at the start."""
        self._do(Event(RESET, self._last_ns))
        self._last_ns = BEFORE_ALL

    def _go_on_from(self, saved: Checkpoint) -> None:
        self._state, self._owed, self._last_ns = saved.posterior, saved.owed, saved.stamp_ns
        self._anew = saved.stamp_ns == BEFORE_ALL
        self._known_map = saved.known or self._learned_map()
        self._sequencer = Sequencer(self.parameters)
        self._sequencer.go_on(None if self._anew else saved.stamp_ns, saved.controls)

    def _do_scheduled(self, before_ns: int) -> None:
        """Does what is to be done between the last set and the one of ``before_ns``."""
        while self._scheduled and self._last_ns <= self._scheduled[0].after_ns < before_ns:
            self._do(self._scheduled.popleft())
