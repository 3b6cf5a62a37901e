"""The benchmarks of nodes under load: real processes, a short time, and counts alone."""

from __future__ import annotations

import itertools

import pytest

from dopslam_ros.lab.bench import load, load_nodes
from dopslam_ros.lab.bench.live_nodes import stamp_of
from dopslam_ros.lab.bench.records import Figure


def values(figures: tuple[Figure, ...]) -> dict[str, float]:
    """The medians by their names."""
    return {one.name: one.median for one in figures}


def test_the_recorder_keeps_all() -> None:
    """Every set and every control that was sent is in the bag."""
    measured = load.recorded(rate=200.0, seconds=2.0)
    found = values(measured.figures)
    assert found["sets lost"] == found["controls lost"] == 0.0
    assert found["sets sent in a second"] > 0.0


def test_what_is_too_much_is_told() -> None:
    """Every set is answered or counted as dropped; some are dropped, and some answered."""
    measured = load.overloaded(brief=0.5, seconds=2.0)
    found = values(measured.figures)
    assert found["sets neither answered nor counted as lost"] == 0.0
    assert 0.0 < found["sets answered in a second under load"]
    assert found["sets answered in a second under load"] < found["sets sent in a second under load"]
    (ratio,) = (one for one in measured.ratios if one.name.startswith("answered"))
    assert ratio.value == pytest.approx(
        found["sets answered in a second under load"]
        / found["sets answered in a second, as many sent"]
    )


def test_an_endless_run() -> None:
    """Stamps go on evenly, and the sets come round again."""
    source = load_nodes.Endless()
    steps = [source.next() for _ in range(load_nodes.ROUND + 2)]
    stamps = [stamp for stamp, _ in steps]
    assert {b - a for a, b in itertools.pairwise(stamps)} == {20_000_000}
    for stamp, messages in steps:
        assert [stamp_of(payload) for payload in messages] == [stamp, stamp]
    first, again = steps[0][1], steps[load_nodes.ROUND][1]
    assert [payload[12:] for payload in first] == [payload[12:] for payload in again]
    assert first != steps[1][1]
