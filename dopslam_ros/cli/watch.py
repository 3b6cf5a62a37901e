"""The command ``dopslam watch``: a run in a terminal, live or from a bag."""

from __future__ import annotations

import contextlib
import math
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from dopslam_ros.bag import BagReader
from dopslam_ros.cli.options import write_json
from dopslam_ros.core.linalg.arrays import wrap_angle
from dopslam_ros.core.models.refusal import Refused
from dopslam_ros.core.settings.layout import LandmarkType
from dopslam_ros.messages import topics
from dopslam_ros.messages.common import read_message
from dopslam_ros.messages.states import read_map, read_ue_state
from dopslam_ros.system.errors import UsageError

WATCHED = (
    topics.CHANNEL_MEASUREMENTS,
    topics.TRUTH_UE,
    topics.UE_STATE,
    topics.LANDMARKS,
    topics.BOUNDS,
    topics.DIAGNOSTICS,
)
COUNTED = (topics.CHANNEL_MEASUREMENTS, topics.UE_STATE, topics.LANDMARKS, topics.BOUNDS)
# Frames in a second, and over how many seconds rates are counted.
FRAME_RATE, WINDOW = 5.0, 5.0
MOST_LANDMARKS = 16
LEVELS = {0: "OK", 1: "WARN", 2: "ERROR", 3: "STALE"}
COLOURS = {"OK": "green", "WARN": "yellow", "STALE": "magenta"}
Frame = Callable[[], Group]


class Board:
    """What was said last, by topic, and how often.

    Args:
        prefix: namespace of the vehicle with a slash at its end.
    """

    def __init__(self, prefix: str) -> None:
        self.prefix = prefix
        self.names = {
            topic.name if topic.name.startswith("/") else prefix + topic.name: topic
            for topic in WATCHED
        }
        self.last: dict[str, Any] = {}
        self.health: dict[str, Any] = {}
        self.refused = 0
        self._times: dict[str, deque[float]] = {topic.name: deque() for topic in WATCHED}

    def take(self, name: str, payload: bytes, seconds: float) -> None:
        """A message; one that cannot be read is counted.

        Args:
            name: full name of its topic.
            payload: its bytes.
            seconds: when it came, on any clock that goes on evenly.
        """
        topic = self.names[name]
        try:
            message = read_message(payload, topic)
        except Refused:
            self.refused += 1
            return
        times = self._times[topic.name]
        times.append(seconds)
        while times and not 0.0 <= seconds - times[0] <= WINDOW:
            times.popleft()
        if topic == topics.DIAGNOSTICS:
            for status in message.status:
                if status.name.startswith(self.prefix):
                    self.health[status.name] = status
        else:
            self.last[topic.name] = message

    def rate(self, topic: topics.Topic) -> float:
        """Messages in a second; NaN before the second one."""
        times = self._times[topic.name]
        span = times[-1] - times[0] if len(times) > 1 else 0.0
        return (len(times) - 1) / span if span > 0.0 else math.nan

    def frame(self) -> Group:
        """All of it to be drawn."""
        return Group(_vehicle(self), _rates(self), _landmarks(self), _health(self))

    def content(self) -> dict[str, Any]:
        """The same in numbers, in SI units and radians, for ``--json``."""
        state, shown = self.last.get(topics.UE_STATE.name), self.last.get(topics.LANDMARKS.name)
        rates = {topic.name: self.rate(topic) for topic in COUNTED}
        content: dict[str, Any] = {
            "rates": {name: rate for name, rate in rates.items() if math.isfinite(rate)},
            "unreadable": self.refused,
            "health": {
                name: {"level": _level(status), "message": status.message}
                for name, status in sorted(self.health.items())
            },
        }
        if state is not None:
            mean, covariance = read_ue_state(state)
            content["state"], content["covariance"] = mean.tolist(), covariance.tolist()
            error = _error(self, state, mean)
            if error is not None:
                content["error"] = error.tolist()
        if shown is not None:
            found = read_map(shown)
            content["landmarks"] = [
                {
                    "id": int(found.ids[n]),
                    "type": LandmarkType(int(found.types[n])).name,
                    "existence": float(landmark.existence_probability),
                    "position": found.positions[n].tolist(),
                    "covariance": found.covariances[n].tolist(),
                }
                for n, landmark in enumerate(shown.landmarks)
            ]
        return content


def _vehicle(board: Board) -> Table:
    """The state with its standard deviations and, where the truth is known, its errors."""
    message = board.last.get(topics.UE_STATE.name)
    where = board.prefix.rstrip("/") or "/"
    table = Table(title=Text(f"vehicle {where}"), title_justify="left", expand=False)
    for column in ("", "estimate", "sigma", "error"):
        table.add_column(column, justify="left" if not column else "right")
    if message is None:
        table.add_row("no state yet", "", "", "")
        return table
    mean, covariance = read_ue_state(message)
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    error = _error(board, message, mean)
    scale = (1.0, 1.0, math.degrees(1.0), 1.0)
    for number, label in enumerate(("x [m]", "y [m]", "heading [deg]", "clock bias [m]")):
        known = "" if error is None else f"{scale[number] * error[number]:+.3f}"
        table.add_row(
            Text(label),
            f"{scale[number] * mean[number]:.3f}",
            f"{scale[number] * sigma[number]:.3f}",
            known,
        )
    return table


def _error(board: Board, message: Any, mean: Any) -> Any:
    """(4,) estimate minus truth, if the last truth is of the same time."""
    truth = board.last.get(topics.TRUTH_UE.name)
    if truth is None or truth.header.stamp != message.header.stamp:
        return None
    error = mean - read_ue_state(truth)[0]
    error[2] = wrap_angle(error[2])
    return error


def _rates(board: Board) -> Text:
    parts = [
        f"{topic.name} {rate:.1f}/s" if math.isfinite(rate := board.rate(topic)) else ""
        for topic in COUNTED
    ]
    text = "   ".join(filter(None, parts)) or "nothing comes twice yet"
    if board.refused:
        text += f"   unreadable: {board.refused}"
    return Text(text, style="cyan")


def _landmarks(board: Board) -> Table:
    """The surest ones first; the BS is known and left out."""
    message = board.last.get(topics.LANDMARKS.name)
    table = Table(title="landmarks", title_justify="left")
    for column in ("id", "type", "exists", "x [m]", "y [m]", "z [m]", "sigma [m]"):
        table.add_column(Text(column), justify="right")
    if message is None:
        return table
    found = read_map(message)
    exists = np.array([float(m.existence_probability) for m in message.landmarks])
    shown = [n for n in np.argsort(-exists, kind="stable") if found.types[n] != LandmarkType.BS]
    for n in shown[:MOST_LANDMARKS]:
        sigma = math.sqrt(max(float(np.trace(found.covariances[n])), 0.0))
        table.add_row(
            str(found.ids[n]),
            LandmarkType(int(found.types[n])).name,
            f"{exists[n]:.2f}",
            *(f"{value:.1f}" for value in found.positions[n]),
            f"{sigma:.2f}",
        )
    if len(shown) > MOST_LANDMARKS:
        table.caption = f"{len(shown) - MOST_LANDMARKS} more"
    return table


def _health(board: Board) -> Table:
    table = Table(title="health", title_justify="left", show_header=False)
    for name, status in sorted(board.health.items()):
        word = _level(status)
        # As text: what others say is no markup.
        colour = COLOURS.get(word, "red")
        table.add_row(Text(name), Text(word, style=colour), Text(status.message))
    if not board.health:
        table.add_row("nobody has told its health yet")
    return table


def _level(status: Any) -> str:
    """Its name; both kinds of Python's messages are taken."""
    level = status.level if isinstance(status.level, int) else ord(status.level)
    return LEVELS.get(level, str(level))


# --- the command ---------------------------------------------------------------------------------


def run(options: Any, console: Console | None = None) -> int:
    """Watches; returns 1 if --once saw no state.

    Raises:
        UsageError: there is no such vehicle in the bag.
        BagError: the bag cannot be read.
    """
    console = console or Console()
    feed: Generator[Board, None, None]
    if options.bag is not None:
        feed = recorded(options.bag, options.namespace, math.inf if options.once else options.rate)
    else:
        feed = live(options.namespace)
    with contextlib.closing(feed):
        return _once(feed, options, console) if options.once else _follow(feed, options, console)


def _once(feed: Iterator[Board], options: Any, console: Console) -> int:
    end = time.monotonic() + options.patience
    board: Board | None = None
    for board in feed:
        enough = topics.UE_STATE.name in board.last and bool(board.health)
        if options.bag is None and (enough or time.monotonic() > end):
            break
    if board is not None:
        console.print(board.frame())
        write_json(options.json, board.content())
    return 0 if board is not None and topics.UE_STATE.name in board.last else 1


def _follow(feed: Iterator[Board], options: Any, console: Console) -> int:
    """Draws until the feed ends; where there is no terminal, the last frame alone."""
    board: Board | None = None
    try:
        with Live(console=console, auto_refresh=False, vertical_overflow="visible") as screen:
            drawn = -math.inf
            for board in feed:
                now = time.monotonic()
                if now - drawn >= 1.0 / FRAME_RATE:
                    drawn = now
                    screen.update(board.frame(), refresh=console.is_terminal)
            if board is not None:
                screen.update(board.frame(), refresh=True)
    finally:  # a live run is watched until Ctrl-C
        if board is not None:
            write_json(options.json, board.content())
    return 0


def recorded(path: Path, namespace: str, rate: float) -> Generator[Board, None, None]:
    """The board of a bag as time goes by, some times as fast as recorded; infinity: at once.

    Raises:
        UsageError: there is no such vehicle in the bag.
        BagError: the bag cannot be read.
    """
    reader = BagReader(path)
    board = Board(_prefix(reader, namespace))
    begin, started = reader.start_time_ns or 0, time.monotonic()
    for message in reader.messages(set(board.names)):
        seconds = 1e-9 * (message.log_time_ns - begin)
        while (early := seconds / rate - (time.monotonic() - started)) > 0.0:
            yield board
            time.sleep(min(early, 0.5 / FRAME_RATE))
        board.take(message.topic, message.payload, seconds)
        yield board
    yield board


def _prefix(reader: BagReader, namespace: str) -> str:
    """The vehicle's, which need not be said where there is one alone."""
    found = topics.vehicle_prefixes(reader.topics)
    wanted = f"/{namespace.strip('/')}/".replace("//", "/")
    if not namespace and len(found) == 1:
        return found[0]
    if wanted not in found:
        have = ", ".join(prefix.rstrip("/") or "/" for prefix in found) or "none"
        raise UsageError(
            f"bag '{reader.path}' has no vehicle '{wanted.rstrip('/') or '/'}'; its vehicles:"
            f" {have} (--namespace)"
        )
    return wanted


def live(namespace: str) -> Generator[Board, None, None]:
    """The board of what is published now, for as long as somebody looks."""
    from dopslam_ros.nodes.listening import listening

    board = Board(f"/{namespace.strip('/')}/".replace("//", "/"))
    with listening(board.names, lambda n, p: board.take(n, p, time.monotonic())) as spin:
        while True:
            spin(0.2 / FRAME_RATE)
            yield board
