"""Gaps in the numbers of a topic's messages: only what surely was lost is counted."""

from __future__ import annotations

from types import SimpleNamespace
from typing import TYPE_CHECKING

import pytest

from dopslam_ros.messages import topics
from dopslam_ros.nodes import losses
from dopslam_ros.nodes.losses import Losses
from dopslam_ros.nodes.middleware import middleware_class

if TYPE_CHECKING:
    from tests.conftest import Ros

TOPIC = topics.ODOMETRY_CONTROL


class Watched:
    """Losses of a topic with real publishers."""

    def __init__(self, ros: Ros) -> None:
        self._ros = ros
        self._node = ros.node("watcher")
        self.losses = Losses(self._node, "/" + TOPIC.name)

    def publisher(self) -> SimpleNamespace:
        """One that the watcher knows of, with a way to leave."""
        before = self._node.count_publishers(TOPIC.name)
        node = self._ros.node(f"car{id(self)}")
        node.create_publisher(middleware_class(TOPIC.type_name), TOPIC.name, 1)
        self._ros.spin_until(lambda: self._node.count_publishers(TOPIC.name) == before + 1)

        def leave() -> None:
            self._ros.remove(node)
            self._ros.spin_until(lambda: self._node.count_publishers(TOPIC.name) == before)

        return SimpleNamespace(leave=leave)

    def counted(self, *numbers: int | None) -> list[int]:
        """What is found missing before each of some messages."""
        return [self.losses.before(number) for number in numbers]


def test_gaps_are_counted(ros: Ros) -> None:
    watched = Watched(ros)
    watched.publisher()
    assert watched.counted(7, 8, 11, 12, 112) == [0, 0, 2, 0, 99]


def test_without_numbers_nothing_is_counted(ros: Ros) -> None:
    watched = Watched(ros)
    watched.publisher()
    assert watched.counted(None, None, 4, None, 9) == [0] * 5


def test_two_publishers_are_not_mixed_up(ros: Ros, monkeypatch: pytest.MonkeyPatch) -> None:
    """Their numbers have nothing to do with each other; one alone is looked at again."""
    monkeypatch.setattr(losses, "BLIND_SECONDS", 0.0)
    watched = Watched(ros)
    watched.publisher()
    other = watched.publisher()
    assert watched.counted(1000, 5, 1001, 6, 1002) == [0] * 5
    other.leave()
    assert watched.counted(1005, 1006, 1010) == [0, 0, 3]


def test_a_publisher_that_starts_again_begins_to_count_anew(ros: Ros) -> None:
    watched = Watched(ros)
    first = watched.publisher()
    assert watched.counted(500, 501) == [0, 0]
    first.leave()
    watched.publisher()
    assert watched.counted(900, 901, 903) == [0, 0, 1]
