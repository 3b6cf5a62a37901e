"""The services of the filter node, the snapshots it leaves, and the events it tells."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any

from dopslam_msgs.srv import LoadMap, SaveMap
from std_srvs.srv import SetBool, Trigger

from dopslam_ros.bag import message_class
from dopslam_ros.core.models.refusal import Refused
from dopslam_ros.core.session.checkpoint import MAP, SNAPSHOT, CheckpointError
from dopslam_ros.core.session.events import Event
from dopslam_ros.core.session.filtering import FilterSession
from dopslam_ros.messages import topics
from dopslam_ros.messages.events import make_event
from dopslam_ros.nodes.errors import StartError
from dopslam_ros.nodes.filter_parameters import StorageParameters
from dopslam_ros.nodes.node import DopslamNode
from dopslam_ros.system.snapshot_writer import SnapshotWriter
from dopslam_ros.system.storage import Store


class FilterControl:
    """Starts a session from what was saved and lets services change it.

    Every change is told on ``filter_events``, so that a replay of the recorded run makes it too.

    Raises:
        StartError: the map to start with cannot be used, or the snapshot's name cannot.
    """

    def __init__(
        self, node: DopslamNode, session: FilterSession, settings: StorageParameters
    ) -> None:
        self._node, self._session, self._settings = node, session, settings
        self._store = Store(settings.map_directory)
        self._events = node.output(topics.FILTER_EVENTS)
        self._map = ""
        self._changes = 0
        self._failed = 0
        try:
            self._writer = self._start_writer()
            if settings.map:
                self._load(settings.map)
        except CheckpointError as error:
            raise StartError(str(error)) from error
        if settings.resume:
            self._resume()
        node.create_service(Trigger, "~/reset", self._on_reset)
        node.create_service(SetBool, "~/pause", self._on_pause)
        node.create_service(SaveMap, "~/save_map", self._on_save)
        node.create_service(LoadMap, "~/load_map", self._on_load)

    def offer_snapshot(self) -> None:
        """To be called after every set: offers the state to be written."""
        if self._writer is not None:
            self._writer.offer(self._session.snapshot())

    def health(self) -> list[tuple[str, Any]]:
        """Values for the diagnostics; a snapshot that could not be written is a problem."""
        values: list[tuple[str, Any]] = [
            ("mapping", self._session.parameters.mapping),
            ("paused", self._session.paused),
            ("map", self._map or "none"),
            ("changes_by_services", self._changes),
        ]
        writer = self._writer
        if writer is None:
            return values
        if writer.failed > self._failed and writer.problem is not None:
            self._failed = writer.failed
            self._node.refuse("snapshot", Refused("snapshot_failed", writer.problem))
        age = "none" if writer.written_at is None else f"{time.monotonic() - writer.written_at:.2f}"
        return [*values, ("snapshots_written", writer.written), ("snapshot_age_s", age)]

    def close(self) -> None:
        """Writes the last snapshot."""
        if self._writer is not None:
            self._writer.close()

    # --- start

    def _start_writer(self) -> SnapshotWriter | None:
        name = self._settings.snapshot
        if not name:
            if self._settings.resume:
                raise CheckpointError(
                    "parameter 'resume' is true: give the name of a 'snapshot' too"
                )
            return None
        # Who wants to run while the snapshot is put together waits for so long at most [s].
        sys.setswitchinterval(min(sys.getswitchinterval(), 5e-4))
        return SnapshotWriter(self._store, name, self._settings.snapshot_period)

    def _resume(self) -> None:
        """Goes on from the snapshot; complains and starts anew where that cannot be."""
        path, log = self._store.path(self._settings.snapshot, SNAPSHOT), self._node.get_logger()
        if not path.exists():
            log.info(f"no snapshot '{path}' to go on from: starting anew")
            return
        try:
            age = time.time() - path.stat().st_mtime
            if age > self._settings.resume_age:
                raise CheckpointError(
                    f"'{path}' was written {age:.0f} s ago, more than the"
                    f" {self._settings.resume_age:g} s of parameter 'resume_age'"
                )
            saved = self._store.read(self._settings.snapshot, SNAPSHOT)
            self._tell(self._session.restore(saved))
        except (CheckpointError, OSError) as error:
            self._node.refuse("resume", Refused("resume_failed", f"{error}; starting anew"))
            return
        log.info(f"going on from '{path}', written {age:.1f} s ago")

    def _load(self, name: str) -> str:
        self._tell(self._session.replace_map(self._store.read(name, MAP)))
        self._map = name
        return str(self._store.path(name, MAP))

    # --- services

    def _on_reset(self, _: Any, response: Any) -> Any:
        return self._answer(response, self._reset)

    def _on_pause(self, request: Any, response: Any) -> Any:
        return self._answer(response, lambda: self._pause(bool(request.data)))

    def _on_save(self, request: Any, response: Any) -> Any:
        def save() -> str:
            known = self._session.known_map()
            response.path = str(self._store.write(request.name, known))
            count = len(known.posterior.landmark_ids)
            return f"{count} landmarks saved in '{response.path}'"

        return self._answer(response, save)

    def _on_load(self, request: Any, response: Any) -> Any:
        def load() -> str:
            response.path = self._load(request.name)
            count = len(self._session.state.landmark_ids)
            return f"{count} landmarks loaded from '{response.path}'"

        return self._answer(response, load)

    def _reset(self) -> str:
        self._tell(self._session.reset())
        return "back to the initial state" + (" and the map of the start" if self._map else "")

    def _pause(self, on: bool) -> str:
        if on == self._session.paused:
            return "paused already" if on else "not paused"
        self._tell(self._session.pause() if on else self._session.go_on())
        return "paused: sets are refused" if on else "going on"

    def _answer(self, response: Any, act: Callable[[], str]) -> Any:
        """Acts and says what came of it, to the caller and in the log."""
        try:
            response.message = act()
            response.success = True
            self._node.get_logger().info(f"service: {response.message}")
        except Exception as error:  # a node never dies of a request
            response.success, response.message = False, str(error) or type(error).__name__
            self._node.refuse("service", Refused("service_refused", str(error)))
        return response

    def _tell(self, event: Event) -> None:
        self._changes += 1
        self._events.publish(make_event(message_class, event))
        self.offer_snapshot()
