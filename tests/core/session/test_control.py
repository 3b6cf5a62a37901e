"""What is done to a running filter: reset, pause, maps, and going on from a snapshot."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest

from dopslam_ros.core.models.refusal import Refused
from dopslam_ros.core.pmb import FilterParameters
from dopslam_ros.core.session.checkpoint import BEFORE_ALL, Checkpoint, CheckpointError
from dopslam_ros.core.session.checkpoint_file import decode, to_bytes
from dopslam_ros.core.session.events import Event, Pauses
from dopslam_ros.core.session.filtering import FilterSession
from dopslam_ros.core.session.output import FilterOutput
from dopslam_ros.core.settings.layout import VEHICLE
from dopslam_ros.simulation.matched import filter_parameters_for
from dopslam_ros.simulation.scenario import load_scenario
from dopslam_ros.simulation.simulator import Snapshot, simulate

SCENARIO = load_scenario("paper")
PARAMETERS = filter_parameters_for(SCENARIO)
KNOWN = replace(PARAMETERS, mapping=False)

UE = len(VEHICLE)


@pytest.fixture(scope="module")
def snapshots() -> list[Snapshot]:
    """A run of the paper's scene, long enough for landmarks to be deactivated and reactivated."""
    return list(simulate(SCENARIO, np.random.default_rng(17)))


def feed(filtering: FilterSession, snapshots: Iterable[Snapshot]) -> list[FilterOutput]:
    outputs: list[FilterOutput] = []
    for s in snapshots:
        outputs += filtering.add_control(s.stamp_ns, s.control.speed, s.control.turn_rate)
        outputs += filtering.add_measurements(s.stamp_ns, s.measurements)
    return outputs


def through_a_file(saved: Checkpoint) -> Checkpoint:
    return decode(to_bytes(saved))


def bytes_of(outputs: list[FilterOutput]) -> list[bytes]:
    """All that is published of an output follows from these."""
    return [
        b"".join(
            part.tobytes()
            for part in (
                o.state.ue_mean,
                o.state.ue_covariance,
                o.landmarks.ids,
                o.landmarks.positions,
                o.landmarks.covariances,
                o.landmarks.existence,
                o.associations.weight,
            )
        )
        for o in outputs
    ]


@pytest.mark.parametrize("density", ["pmb", "pmbm"])
@pytest.mark.parametrize("stop", [0, 1, 13, 30])
def test_going_on_from_a_snapshot_gives_the_same_bytes(
    snapshots: list[Snapshot], stop: int, density: str
) -> None:
    parameters = replace(PARAMETERS, density=density)
    whole = FilterSession(parameters)
    feed(whole, snapshots[:stop])
    saved = through_a_file(whole.snapshot())
    rest = bytes_of(feed(whole, snapshots[stop:]))

    resumed = FilterSession(parameters)
    resumed.restore(saved)
    assert bytes_of(feed(resumed, snapshots[stop:])) == rest
    with pytest.raises(Refused, match="already"):
        feed(resumed, snapshots[-1:])


def test_a_snapshot_has_the_controls_that_came_ahead_of_their_sets(
    snapshots: list[Snapshot],
) -> None:
    whole = FilterSession(PARAMETERS)
    feed(whole, snapshots[:10])
    for s in snapshots[10:20]:  # the controls are ahead, the sets late
        list(whole.add_control(s.stamp_ns, s.control.speed, s.control.turn_rate))
    saved = through_a_file(whole.snapshot())
    assert len(saved.controls) == 11

    def sets(filtering: FilterSession) -> list[bytes]:
        outputs: list[FilterOutput] = []
        for s in snapshots[10:20]:
            outputs += filtering.add_measurements(s.stamp_ns, s.measurements)
        return bytes_of(outputs + feed(filtering, snapshots[20:]))

    resumed = FilterSession(PARAMETERS)
    resumed.restore(saved)
    assert sets(resumed) == sets(whole)


def test_reset_is_the_beginning(snapshots: list[Snapshot]) -> None:
    fresh = bytes_of(feed(FilterSession(PARAMETERS), snapshots[20:]))
    filtering = FilterSession(PARAMETERS)
    feed(filtering, snapshots[:20])
    event = filtering.reset()
    assert event == Event("reset", snapshots[19].stamp_ns)
    np.testing.assert_array_equal(filtering.state.ue_mean, PARAMETERS.initial_state)
    # As if the filter had been started now: no motion leads to the first set.
    outputs = feed(filtering, snapshots[20:])
    assert bytes_of(outputs) == fresh
    assert [o.anew for o in outputs[:2]] == [True, False]


def test_reset_keeps_the_map_of_the_start_and_not_a_later_one(snapshots: list[Snapshot]) -> None:
    first = FilterSession(PARAMETERS)
    feed(first, snapshots)
    known = through_a_file(first.known_map())
    filtering = FilterSession(PARAMETERS)
    filtering.replace_map(known)
    feed(filtering, snapshots[:5])
    short = filtering.known_map()
    filtering.replace_map(replace(short, posterior=known.posterior))
    filtering.reset()
    assert (
        filtering.state.density.mean[UE:].tobytes() == known.posterior.density.mean[UE:].tobytes()
    )
    other = FilterSession(PARAMETERS)
    feed(other, snapshots[:5])
    other.replace_map(known)
    other.reset()
    assert len(other.state.density.track_id) == 0


def test_a_map_is_loaded_around_the_vehicle(snapshots: list[Snapshot]) -> None:
    first = FilterSession(PARAMETERS)
    feed(first, snapshots)
    known = first.known_map()
    filtering = FilterSession(PARAMETERS)
    feed(filtering, snapshots[:5])
    before = filtering.state
    filtering.replace_map(known)
    after = filtering.state
    np.testing.assert_array_equal(after.ue_mean, before.ue_mean)
    np.testing.assert_array_equal(after.ue_covariance, before.ue_covariance)
    assert not after.density.covariance[:UE, UE:].any()
    own = known.posterior.density.covariance[UE:, UE:]
    np.testing.assert_array_equal(after.density.covariance[UE:, UE:], own)
    with pytest.raises(CheckpointError, match="bs_position"):
        FilterSession(replace(PARAMETERS, bs_position=(1.0, 0.0, 40.0))).replace_map(known)
    assert feed(filtering, snapshots[5:10])[-1].landmarks.existence.max() > 0.9


def test_a_known_map_is_the_same_bytes_after_a_run(snapshots: list[Snapshot]) -> None:
    first = FilterSession(PARAMETERS)
    feed(first, snapshots)
    known = first.known_map()
    data = to_bytes(known)
    filtering = FilterSession(KNOWN)
    filtering.replace_map(through_a_file(known))
    active = {len(o.state.density.track_id) for o in feed(filtering, snapshots)}
    assert len(active) > 1, "landmarks fell inactive and woke up meanwhile"
    assert to_bytes(filtering.known_map()) == data
    assert set(filtering.state.landmark_ids) == set(known.posterior.landmark_ids)


def test_a_known_map_outlives_a_restart(snapshots: list[Snapshot]) -> None:
    first = FilterSession(PARAMETERS)
    feed(first, snapshots)
    known = first.known_map()
    filtering = FilterSession(KNOWN)
    filtering.replace_map(known)
    feed(filtering, snapshots[:25])
    resumed = FilterSession(KNOWN)
    resumed.restore(through_a_file(filtering.snapshot()))
    assert bytes_of(feed(resumed, snapshots[25:])) == bytes_of(feed(filtering, snapshots[25:]))
    assert to_bytes(resumed.known_map()) == to_bytes(known)


def test_a_pause_refuses_sets_and_the_next_one_is_predicted_to(snapshots: list[Snapshot]) -> None:
    filtering = FilterSession(PARAMETERS)
    feed(filtering, snapshots[:10])
    before = filtering.state
    filtering.pause()
    assert filtering.paused
    for s in snapshots[10:14]:
        list(filtering.add_control(s.stamp_ns, s.control.speed, s.control.turn_rate))
        with pytest.raises(Refused) as caught:
            filtering.add_measurements(s.stamp_ns, s.measurements)
        assert caught.value.reason == "paused"
    assert filtering.state is before
    event = filtering.go_on()
    assert event.until_ns == snapshots[13].stamp_ns
    rest = bytes_of(feed(filtering, snapshots[14:]))

    without = FilterSession(PARAMETERS)  # as if those sets had never been
    feed(without, snapshots[:10])
    for s in snapshots[10:14]:
        list(without.add_control(s.stamp_ns, s.control.speed, s.control.turn_rate))
    assert rest == bytes_of(feed(without, snapshots[14:]))


def test_pauses_are_a_matter_of_stamps_and_order_alone() -> None:
    """Late sets, pauses in a row, and a time that begins anew; live, then known beforehand."""
    # Stamps as they come; None begins a pause, True ends it.
    script = [1, 2, None, 3, 2, 5, 4, True, 4, 6, 5, None, True, None, 7, True, None, 8, True, 7]
    script += [9, 1, 2, 3, None, 7, True, 7, 8]

    def take(pauses: Pauses, taken: list[int], stamp: int) -> None:
        with contextlib.suppress(Refused):
            pauses.check(stamp, newest[0])
            taken.append(stamp)
            # As the stream does: a jump back begins anew.
            newest[0] = stamp if stamp < newest[0] - 5 else max(newest[0], stamp)

    live, events, taken, newest = Pauses(), [], list[int](), [BEFORE_ALL]
    for entry in script:
        if entry is None:
            events.append(live.begin(newest[0]))
        elif entry is True:
            events.append(live.end())
        else:
            take(live, taken, entry)
    assert taken == [1, 2, 2, 6, 5, 9, 1, 2, 3, 8]

    known, again, newest = Pauses(), list[int](), [BEFORE_ALL]
    for event in events:
        if event.kind == "pause":
            known.begin(event.after_ns)
        else:
            known.end(event.until_ns)
    for entry in script:
        if entry is not None and entry is not True:
            take(known, again, entry)
    assert again == taken


def test_events_scheduled_ahead_give_the_same_bytes(snapshots: list[Snapshot]) -> None:
    """A live run with everything, and its replay, whose inputs interleave otherwise."""
    other = FilterSession(PARAMETERS)
    feed(other, list(simulate(SCENARIO, np.random.default_rng(99))))
    known, live = other.known_map(), FilterSession(PARAMETERS)
    events, outputs = [live.replace_map(known)], feed(live, snapshots[:8])
    events.append(live.reset())
    outputs += feed(live, snapshots[8:16])
    events.append(live.pause())
    for s in snapshots[16:20]:
        list(live.add_control(s.stamp_ns, s.control.speed, s.control.turn_rate))
        with pytest.raises(Refused):
            live.add_measurements(s.stamp_ns, s.measurements)
    events.append(live.go_on())
    outputs += feed(live, snapshots[20:25])
    events.append(live.replace_map(known))
    outputs += feed(live, snapshots[25:])
    assert [e.after_ns for e in events][:2] == [BEFORE_ALL, snapshots[7].stamp_ns]

    again = FilterSession(replace(PARAMETERS, control_wait=1000.0))
    for event in events:
        again.schedule(event)
    late: list[FilterOutput] = []
    for s in snapshots:  # all the sets first: none may be taken because of when it came
        try:
            late += again.add_measurements(s.stamp_ns, s.measurements)
        except Refused as error:
            assert error.reason == "paused"
    for s in snapshots:
        late += again.add_control(s.stamp_ns, s.control.speed, s.control.turn_rate)
    assert bytes_of(late) == bytes_of(outputs)


def test_a_snapshot_in_the_place_of_a_map_is_refused_and_changes_nothing(
    snapshots: list[Snapshot],
) -> None:
    filtering = FilterSession(PARAMETERS)
    feed(filtering, snapshots[:3])
    state = filtering.state
    with pytest.raises(CheckpointError):
        filtering.replace_map(filtering.snapshot())
    with pytest.raises(CheckpointError):
        filtering.restore(filtering.known_map())
    with pytest.raises(CheckpointError):
        filtering.schedule(Event("resume", BEFORE_ALL, saved=filtering.known_map()))
    assert filtering.state is state


def test_the_settings_of_a_session_are_those_of_a_filter() -> None:
    """A node's own settings, file names among them, are nobody else's business."""
    from dopslam_ros.nodes.filter_parameters import FilterNodeParameters

    saved = FilterSession(FilterNodeParameters()).snapshot()
    assert "map_frame" not in saved.parameters
    assert set(saved.parameters) == set(FilterSession(FilterParameters()).snapshot().parameters)
