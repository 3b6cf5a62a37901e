"""The sequencer: the same releases however the two topics interleave."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from dopslam_ros.core.models.motion import Control, ControlSpan, Drift
from dopslam_ros.core.models.refusal import Refused
from dopslam_ros.core.session import sequence
from dopslam_ros.core.session.ordering import UNCONFIRMED
from dopslam_ros.core.session.sequence import MOST_PENDING, Sequencer, Timed
from dopslam_ros.core.settings.model import OnlineParameters

SECOND = 1_000_000_000
Released = list[Timed[str]]


def sequencer_of(wait: float, window: float = 0.0, **others: float) -> Sequencer[str]:
    """With controls that hold for good, unless told otherwise."""
    settings = {"control_timeout": 1e9, **others}
    return Sequencer(OnlineParameters(control_wait=wait, reorder_window=window, **settings))


def feed(
    order: list[str],
    controls: list[tuple[int, float]],
    items: list[int],
    wait: float = 1e6,
    window: float = 0.0,
) -> tuple[Released, list[str]]:
    """Adds the inputs in an order ('c' or 'i') and gives what was released and refused."""
    sequencer: Sequencer[str] = sequencer_of(wait, window)
    released: Released = []
    refused = []
    waiting_controls, waiting_items = iter(controls), iter(items)
    for kind in order:
        try:
            if kind == "c":
                stamp, speed = next(waiting_controls)
                sequencer.add_control(stamp, speed, 0.1 * speed)
            else:
                stamp = next(waiting_items)
                sequencer.add(stamp, f"item {stamp}")
        except Refused as refusal:
            refused.append(refusal.reason)
        released += sequencer.ready()
    released += sequencer.flush()
    assert sequencer.pending == 0
    return released, refused


def drawn(rng: np.random.Generator) -> tuple[list[tuple[int, float]], list[int]]:
    """Increasing stamps on both topics, some of them common; controls until the end."""
    stamps = rng.choice(np.arange(1, 60), 30, replace=False) * SECOND // 4
    items = np.sort(stamps[:12])
    times = np.sort(np.concatenate([rng.choice(items, 5, replace=False), stamps[15:]]))
    times = np.unique(np.append(times, 60 * SECOND))
    return [(int(t), float(v)) for t, v in zip(times, rng.normal(size=len(times)), strict=True)], [
        int(item) for item in items
    ]


@pytest.mark.parametrize("seed", range(40))
def test_the_result_does_not_depend_on_the_interleaving(seed: int) -> None:
    rng = np.random.default_rng(seed)
    controls, items = drawn(rng)
    kinds = ["c"] * len(controls) + ["i"] * len(items)
    reference, refused = feed(kinds, controls, items)
    assert refused == [] and len(reference) == len(items)
    assert feed(kinds[::-1], controls, items) == (reference, [])
    for _ in range(5):
        order = [str(kind) for kind in rng.permutation(kinds)]
        assert feed(order, controls, items) == (reference, [])


@pytest.mark.parametrize("order", ["ciic", "iicc", "icic", "cici"])
def test_nor_when_stamps_jump_back_within_a_topic(order: str) -> None:
    controls, items = [(1 * SECOND, 5.0), (2 * SECOND, 6.0)], [2 * SECOND, 1 * SECOND]
    assert feed(list(order), controls, items) == feed(list("ccii"), controls, items)


@pytest.mark.parametrize("seed", range(20))
def test_spans_fill_the_time_between_with_the_controls_that_hold(seed: int) -> None:
    rng = np.random.default_rng(seed)
    controls, items = drawn(rng)
    released, _ = feed(["c"] * len(controls) + ["i"] * len(items), controls, items)
    assert [timed.stamp_ns for timed in released] == sorted(items)
    assert released[0].spans == ()

    def valid_at(stamp: float) -> Control:
        before = [Control(v, 0.1 * v) for t, v in controls if t <= stamp]
        return before[-1] if before else Control(0.0, 0.0)

    for before, after in itertools.pairwise(released):
        total = sum(span.duration for span in after.spans)
        assert total == pytest.approx((after.stamp_ns - before.stamp_ns) / SECOND, abs=1e-9)
        assert all(span.duration > 0.0 for span in after.spans)
        time = float(before.stamp_ns)
        for span in after.spans:
            assert span.control == valid_at(time + 0.5 * SECOND * span.duration)
            time += SECOND * span.duration
        if after.control is not None:
            assert after.control == valid_at(after.stamp_ns)
        first = controls[0][0]
        assert after.complete == (first <= before.stamp_ns)


def test_an_item_waits_for_a_control_of_its_time_or_later() -> None:
    sequencer: Sequencer[str] = sequencer_of(1.0)
    sequencer.add_control(1 * SECOND, 5.0, 0.0)
    sequencer.add(2 * SECOND, "a")
    assert list(sequencer.ready()) == [] and sequencer.pending == 1
    sequencer.add_control(2 * SECOND - 1, 6.0, 0.0)
    assert list(sequencer.ready()) == []
    sequencer.add_control(2 * SECOND, 7.0, 0.0)
    (timed,) = sequencer.ready()
    assert timed == Timed(2 * SECOND, "a", (), Control(7.0, 0.0), True)


def test_the_wait_is_bounded_by_newer_items() -> None:
    sequencer: Sequencer[str] = sequencer_of(1.0)
    sequencer.add_control(0, 5.0, 0.25)
    assert [t.item for t in _added(sequencer, 0, "zero")] == ["zero"]
    assert _added(sequencer, SECOND // 2, "a") == []
    assert _added(sequencer, 3 * SECOND // 2 - 1, "b") == []
    (timed,) = _added(sequencer, 3 * SECOND // 2, "c")
    assert timed.item == "a" and not timed.complete
    # The last control known goes on.
    assert timed.spans == (ControlSpan(Control(5.0, 0.25), 0.5),)
    assert timed.control == Control(5.0, 0.25)
    assert sequencer.pending == 2


def _added(sequencer: Sequencer[str], stamp: int, item: str) -> Released:
    sequencer.add(stamp, item)
    return list(sequencer.ready())


def test_no_more_wait_than_a_number() -> None:
    sequencer: Sequencer[str] = sequencer_of(1e6)
    for number in range(MOST_PENDING):
        assert _added(sequencer, number + 1, "x") == []
    assert len(_added(sequencer, MOST_PENDING + 1, "x")) == 1
    assert sequencer.pending == MOST_PENDING


def test_without_any_control_the_vehicle_stands_and_this_is_said() -> None:
    released, _ = feed(["i", "i"], [], [SECOND, 2 * SECOND])
    assert [timed.complete for timed in released] == [False, False]
    assert [timed.control for timed in released] == [None, None]
    assert released[1].spans == (ControlSpan(Control(0.0, 0.0), 1.0),)


def test_a_real_control_of_zero_is_not_an_unknown_one() -> None:
    released, _ = feed(["c", "i", "i", "c"], [(0, 0.0), (9 * SECOND, 0.0)], [SECOND, 2 * SECOND])
    assert [timed.complete for timed in released] == [True, True]
    assert released[1].control == Control(0.0, 0.0)


def test_flush_releases_all_in_order() -> None:
    sequencer: Sequencer[str] = sequencer_of(100.0)
    sequencer.add_control(SECOND, 3.0, 0.0)
    for stamp in (1, 2, 3):
        sequencer.add(stamp * SECOND, str(stamp))
    released = list(sequencer.flush())
    assert [timed.item for timed in released] == ["1", "2", "3"]
    assert [timed.complete for timed in released] == [True, False, False]
    assert list(sequencer.flush()) == []


def reason_of(action: object, *arguments: object) -> tuple[str, str]:
    assert callable(action)
    with pytest.raises(Refused) as caught:
        action(*arguments)
    return caught.value.reason, str(caught.value)


def test_refusals_say_why_and_change_nothing() -> None:
    sequencer: Sequencer[str] = sequencer_of(1.0)
    sequencer.add_control(5 * SECOND, 3.0, 0.0)
    sequencer.add(4 * SECOND, "a")
    assert len(list(sequencer.ready())) == 1
    reason, text = reason_of(sequencer.add, 4 * SECOND, "again")
    assert reason == "duplicate_stamp" and "4.000000000 s" in text
    assert reason_of(sequencer.add, 3 * SECOND, "late")[0] == "late"
    sequencer.add(6 * SECOND, "b")
    assert reason_of(sequencer.add, 6 * SECOND, "twin")[0] == "duplicate_stamp"
    assert reason_of(sequencer.add, 5 * SECOND, "late")[0] == "late"
    assert reason_of(sequencer.add_control, 5 * SECOND, 3.0, 0.0)[0] == "duplicate_stamp"
    assert reason_of(sequencer.add_control, 2 * SECOND, 3.0, 0.0)[0] == "late_control"
    for speed, turn in ((np.nan, 0.0), (0.0, np.nan), (np.inf, 0.0), (0.0, -np.inf), (1e9, 0.0)):
        reason, text = reason_of(sequencer.add_control, 7 * SECOND, speed, turn)
        assert reason == "invalid_control" and f"{speed:g}" in text
    sequencer.add_control(6 * SECOND, 4.0, 0.0)
    assert [timed.item for timed in sequencer.ready()] == ["b"]


def test_old_controls_are_forgotten() -> None:
    sequencer: Sequencer[str] = sequencer_of(1.0)
    for second in range(1, 2000):
        sequencer.add_control(second * SECOND, 1.0, 0.0)
        assert len(_added(sequencer, second * SECOND, "x")) == 1
    assert len(sequencer.controls) < 5


def test_controls_without_sets_are_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    """However many come: twice the number that is used, and the one in force."""
    monkeypatch.setattr(sequence, "MOST_CONTROLS", 50)
    sequencer = sequencer_of(1e6)
    for second in range(1000):
        sequencer.add_control(second * SECOND, float(second), 0.0)
    assert len(sequencer.controls) == 101
    assert sequencer.controls[-1][0] == 999 * SECOND
    assert not sequencer.take_problems()  # no set has missed them


@pytest.mark.parametrize("arrival", [202, 210, 250, 300])
def test_of_too_many_controls_the_newest_are_used(
    arrival: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The one in force holds until the first of them, whenever the set arrives among them."""
    monkeypatch.setattr(sequence, "MOST_CONTROLS", 100)
    sequencer = sequencer_of(1e6)
    sequencer.add(0, "first")
    released = []
    for tick in range(301):
        sequencer.add_control(tick * SECOND // 8, float(tick), 0.0)
        if tick == arrival:
            sequencer.add(25 * SECOND + SECOND // 16, "second")
        released += sequencer.ready()
    assert [timed.item for timed in released] == ["first", "second"]
    spans = released[1].spans
    assert [span.control.speed for span in spans] == [0.0, *map(float, range(101, 201))]
    assert [span.duration for span in spans] == [101 / 8, *[1 / 8] * 99, 1 / 16]
    assert released[1].complete
    assert sequencer.take_problems() == {"unused_control": 100}


def test_a_stamp_far_ahead_does_not_lock_out_the_rest() -> None:
    """A single jump is not used; one that the next stamp confirms is believed, and nothing lost."""
    sequencer: Sequencer[str] = sequencer_of(1.0)
    far = 10**9 * SECOND
    sequencer.add_control(1 * SECOND, 1.0, 0.0)
    sequencer.add(1 * SECOND, "first")
    sequencer.add_control(far, 9.0, 0.0)
    sequencer.add(far, "glitch")
    sequencer.add_control(2 * SECOND, 2.0, 0.0)
    sequencer.add(2 * SECOND, "second")
    assert sequencer.take_problems() == {UNCONFIRMED: 2}
    sequencer.add(500 * SECOND, "after a long stop")
    assert list(sequencer.ready())[-1].item == "second" and sequencer.pending == 0
    sequencer.add(501 * SECOND, "third")
    released = list(sequencer.end())
    assert [timed.item for timed in released] == ["after a long stop", "third"]
    assert released[0].control == Control(2.0, 0.0) and not released[0].anew
    assert sequencer.take_problems() == {}
    sequencer.add(9 * SECOND, "glitch back")
    assert list(sequencer.end()) == [] and sequencer.take_problems() == {UNCONFIRMED: 1}


@pytest.mark.parametrize("seed", range(20))
def test_a_bag_played_again_gives_the_same_again(seed: int) -> None:
    """Each round is like the first, however the topics interleave; nothing is lost."""
    rng = np.random.default_rng(seed)
    controls, items = drawn(rng)
    kinds = ["c"] * len(controls) + ["i"] * len(items)
    once, _ = feed(kinds, controls, items)
    rounds = [str(kind) for kind in rng.permutation(kinds * 3)]
    released, refused = feed(rounds, controls * 3, items * 3)
    assert refused == []
    count = len(items)
    assert released[:count] == once
    for start in (count, 2 * count):
        assert [replace(t, anew=False) for t in released[start : start + count]] == once
        assert [t.anew for t in released[start : start + count]] == [True] + [False] * (count - 1)


@pytest.mark.parametrize("seed", range(20))
def test_inside_the_window_the_order_of_arrival_does_not_count(seed: int) -> None:
    rng = np.random.default_rng(seed)
    controls, items = drawn(rng)
    kinds = ["c"] * len(controls) + ["i"] * len(items)
    expected, _ = feed(kinds, controls, items)

    def delayed(stamps: list[int]) -> list[int]:
        """Indices in the order of arrival, each up to the window late."""
        return [int(i) for i in np.argsort(np.array(stamps) + rng.uniform(0, SECOND, len(stamps)))]

    order = [str(kind) for kind in rng.permutation(kinds)]
    mixed_controls = [controls[i] for i in delayed([stamp for stamp, _ in controls])]
    mixed_items = [items[i] for i in delayed(items)]
    assert feed(order, mixed_controls, mixed_items, window=1.0) == (expected, [])
    # A window too small refuses the late ones, the same whatever the interleaving.
    first = feed(order, mixed_controls, mixed_items, window=0.1)
    assert {"late", "late_control"} & set(first[1]) or len(first[0]) == len(items)
    kinds = kinds[::-1]
    released, refused = feed(kinds, mixed_controls, mixed_items, window=0.1)
    assert released == first[0] and sorted(refused) == sorted(first[1])


def test_the_window_delays_by_its_length() -> None:
    sequencer = sequencer_of(5.0, window=0.5)
    sequencer.add_control(9 * SECOND, 1.0, 0.0)
    tenth = SECOND // 10
    assert _added(sequencer, 20 * tenth, "b") == []
    assert _added(sequencer, 22 * tenth, "c") == []
    assert _added(sequencer, 18 * tenth, "a") == []
    assert reason_of(sequencer.add, 18 * tenth, "a again")[0] == "duplicate_stamp"
    assert reason_of(sequencer.add, 17 * tenth, "too late")[0] == "late"
    assert [t.item for t in _added(sequencer, 23 * tenth, "d")] == ["a"]
    assert [t.item for t in sequencer.flush()] == ["b", "c", "d"]
    assert reason_of(sequencer.add, 21 * tenth, "passed")[0] == "late"


@pytest.mark.parametrize("topic", ["items", "controls"])
def test_time_that_begins_anew_on_one_topic_only_is_given_up(topic: str) -> None:
    """Sets get controls again after a while, though not those from before."""
    sequencer = sequencer_of(1.0)
    released: Released = []
    for tick in range(300):
        back = 100 <= tick < 150 if topic == "controls" else tick >= 100
        item = tick + 1 - (90 if back and topic == "items" else 0)
        control = tick + 1 - (90 if back and topic == "controls" else 0)
        sequencer.add_control(control * SECOND // 10, float(tick), 0.0)
        released += _added(sequencer, item * SECOND // 10, str(tick))
    assert released[99].complete and not released[105].complete
    assert sum(timed.anew for timed in released) == (topic == "items")
    assert all(timed.complete for timed in released[-50:])


def test_an_old_control_is_worth_less_and_less() -> None:
    """What is lost adds up to the same however the time is cut into pieces."""
    aging = {"control_timeout": 2.0, "coasting_acceleration": 1.0}
    aging["coasting_turn_acceleration"] = 0.3
    whole, pieces = (sequencer_of(1e6, **aging) for _ in range(2))
    for sequencer in (whole, pieces):
        sequencer.add_control(0, 5.0, 0.1)
    for stamp in (1, 3, 4, 7, 20):
        pieces.add(stamp * SECOND, str(stamp))
    for stamp in (1, 20):
        whole.add(stamp * SECOND, str(stamp))

    def drift(sequencer: Sequencer[str]) -> dict[int, list[Drift]]:
        return {t.stamp_ns // SECOND: [s.drift for s in t.spans] for t in sequencer.flush()}

    (total,) = drift(whole)[20]
    parts = drift(pieces)
    assert parts[3][0].along == pytest.approx(0.25)  # (1 m/s^2 * (1 s)^2 / 2)^2
    assert sum(d.along for each in parts.values() for d in each) == pytest.approx(total.along)
    assert sum(d.heading for each in parts.values() for d in each) == pytest.approx(total.heading)
    # 10 s of acceleration, then 8 s at the speed reached.
    assert total.along == pytest.approx((50.0 + 80.0) ** 2)
    assert total.heading == pytest.approx(np.pi**2)
