"""The benchmarks of the nodes: real processes, a short time."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from dopslam_ros.lab.bench import live


def test_sets_through_the_filter_and_through_a_relay() -> None:
    """Every set is answered by both; the listener hears every topic."""
    measured = live.exchanges(rate=20.0, seconds=1.0)
    found = {one.name: one for one in measured.figures}
    for name in ("set sent to pose received", "set sent to set handed on"):
        assert found[name].count == 20
        assert 0.0 < found[name].minimum <= found[name].median <= found[name].p99
    assert found["sets lost by the filter"].median == 0.0
    assert found["sets lost by the relay"].median == 0.0
    assert 0.0 < found["a core's time taken by the filter node"].median < 200.0
    assert len(measured.ratios) == 2 and "on 7 topics" in measured.notes[0]


def test_stamp_of_a_message() -> None:
    from dopslam_ros.lab.bench.live_nodes import sets_of, stamp_of

    for stamp, messages in sets_of(rate=100.0, steps=3):
        assert [stamp_of(payload) for payload in messages.values()] == [stamp] * len(messages)


def test_how_soon_a_node_is_ready(tmp_path: Path) -> None:
    assert 0.0 < live._seconds_to_ready(live.BARE_NODE, tmp_path, {}) < live.PATIENCE


def test_a_node_that_dies_is_told_with_its_last_words(tmp_path: Path) -> None:
    command = [sys.executable, "-c", "raise SystemExit('no such thing')"]
    with pytest.raises(RuntimeError, match="a node ended: no such thing"):
        live._seconds_to_ready(command, tmp_path, {})
