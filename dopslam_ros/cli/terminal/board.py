"""What the nodes of a vehicle said last, and how often."""

from __future__ import annotations

import math
from collections import deque
from typing import Any

from dopslam_ros.core.linalg.arrays import wrap_angle
from dopslam_ros.core.models.refusal import Refused
from dopslam_ros.core.settings.layout import HEADING, LandmarkType
from dopslam_ros.messages import topics
from dopslam_ros.messages.common import read_message
from dopslam_ros.messages.states import read_map, read_ue_state

WATCHED = (
    topics.CHANNEL_MEASUREMENTS,
    topics.TRUTH_UE,
    topics.UE_STATE,
    topics.LANDMARKS,
    topics.BOUNDS,
    topics.DIAGNOSTICS,
)
COUNTED = (topics.CHANNEL_MEASUREMENTS, topics.UE_STATE, topics.LANDMARKS, topics.BOUNDS)
# Rates are counted over so many seconds.
WINDOW = 5.0
LEVELS = {0: "OK", 1: "WARN", 2: "ERROR", 3: "STALE"}


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

    def error_of(self, message: Any, mean: Any) -> Any:
        """(4,) estimate minus truth, if the last truth is of the time of the message, else None."""
        truth = self.last.get(topics.TRUTH_UE.name)
        if truth is None or truth.header.stamp != message.header.stamp:
            return None
        error = mean - read_ue_state(truth)[0]
        error[HEADING] = wrap_angle(error[HEADING])
        return error

    def content(self) -> dict[str, Any]:
        """The same in numbers, in SI units and radians, for ``--json``."""
        state, shown = self.last.get(topics.UE_STATE.name), self.last.get(topics.LANDMARKS.name)
        rates = {topic.name: self.rate(topic) for topic in COUNTED}
        content: dict[str, Any] = {
            "rates": {name: rate for name, rate in rates.items() if math.isfinite(rate)},
            "unreadable": self.refused,
            "health": {
                name: {"level": level_of(status), "message": status.message}
                for name, status in sorted(self.health.items())
            },
        }
        if state is not None:
            mean, covariance = read_ue_state(state)
            content["state"], content["covariance"] = mean.tolist(), covariance.tolist()
            error = self.error_of(state, mean)
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


def level_of(status: Any) -> str:
    """Its name; both kinds of Python's messages are taken."""
    level = status.level if isinstance(status.level, int) else ord(status.level)
    return LEVELS.get(level, str(level))
