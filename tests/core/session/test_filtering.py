"""Sessions: sets that are bad, empty, late or without control, and trouble in the mathematics."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from dopslam_ros.core.linalg.arrays import FloatArray
from dopslam_ros.core.linalg.jit import from_python
from dopslam_ros.core.models import motion
from dopslam_ros.core.models.measurements import MeasurementSet
from dopslam_ros.core.models.motion import Control, ControlSpan, span_rows
from dopslam_ros.core.models.refusal import Refused
from dopslam_ros.core.monitoring import recovery as recovery_module
from dopslam_ros.core.pmb import FilterParameters, Posterior, initial_posterior, prepare, step
from dopslam_ros.core.session.filtering import FilterSession
from dopslam_ros.core.session.output import FilterOutput
from dopslam_ros.core.settings.layout import DIM, DOPPLER
from dopslam_ros.core.settings.model import with_doppler_std
from dopslam_ros.simulation.matched import filter_parameters_for
from dopslam_ros.simulation.scenario import load_scenario
from dopslam_ros.simulation.simulator import Snapshot, simulate

propagate_spans = from_python(motion.propagate_spans)

SCENARIO = load_scenario("paper")
PARAMETERS = filter_parameters_for(SCENARIO)


@pytest.fixture(scope="module")
def snapshots() -> list[Snapshot]:
    """A short run of the paper's scene."""
    short = replace(SCENARIO, controls=SCENARIO.controls[:10])
    return list(simulate(short, np.random.default_rng(31)))


def drive(
    snapshots: list[Snapshot], order: list[str], parameters: FilterParameters = PARAMETERS
) -> list[FilterOutput]:
    filtering = FilterSession(parameters)
    outputs: list[FilterOutput] = []
    controls, sets = iter(snapshots), iter(snapshots)
    for kind in order:
        if kind == "c":
            s = next(controls)
            outputs += filtering.add_control(s.stamp_ns, s.control.speed, s.control.turn_rate)
        else:
            s = next(sets)
            outputs += filtering.add_measurements(s.stamp_ns, s.measurements)
    outputs += filtering.flush()
    return outputs


def stepped(
    state: Posterior, measurements: MeasurementSet, spans: Sequence[ControlSpan], speed: float
) -> Posterior:
    """The state after one step."""
    return step(state, prepare(measurements, PARAMETERS), spans, speed, PARAMETERS)[0]


def bytes_of(outputs: list[FilterOutput]) -> list[bytes]:
    return [
        o.state.density.mean.tobytes()
        + o.state.density.covariance.tobytes()
        + o.state.density.existence.tobytes()
        + o.state.density.track_id.tobytes()
        + o.landmarks.positions.tobytes()
        for o in outputs
    ]


def test_the_session_is_the_steps_one_after_the_other(snapshots: list[Snapshot]) -> None:
    outputs = drive(snapshots, ["c", "m"] * 10)
    state = initial_posterior(PARAMETERS)
    previous = None
    for output, snapshot in zip(outputs, snapshots, strict=True):
        spans = [] if previous is None else [ControlSpan(previous, SCENARIO.period)]
        state = stepped(state, snapshot.measurements, spans, snapshot.control.speed)
        previous = snapshot.control
        assert output.stamp_ns == snapshot.stamp_ns and output.control == snapshot.control
        np.testing.assert_array_equal(output.state.density.mean, state.density.mean)


@pytest.mark.parametrize("seed", range(6))
def test_the_same_inputs_give_the_same_bytes_in_any_interleaving(
    snapshots: list[Snapshot], seed: int
) -> None:
    patient = replace(PARAMETERS, control_wait=1000.0)
    reference = bytes_of(drive(snapshots, ["c"] * 10 + ["m"] * 10, patient))
    kinds = ["c"] * 10 + ["m"] * 10
    order = [str(k) for k in np.random.default_rng(seed).permutation(kinds)]
    assert bytes_of(drive(snapshots, order, patient)) == reference


def test_an_empty_set_is_processed_and_counted(snapshots: list[Snapshot]) -> None:
    empty = MeasurementSet(np.zeros((0, DIM)), np.zeros((0, DIM, DIM)))
    filtering = FilterSession(PARAMETERS)
    assert list(filtering.add_control(10**9, 22.22, 0.3)) == []
    (first,) = filtering.add_measurements(10**9, empty)
    assert filtering.problems == {"empty_set": 1}
    np.testing.assert_array_equal(first.state.density.mean, PARAMETERS.initial_state)
    list(filtering.add_control(2 * 10**9, 22.22, 0.3))
    (second,) = filtering.add_measurements(2 * 10**9, empty)
    assert np.hypot(*(second.state.ue_mean - first.state.ue_mean)[:2]) > 20.0
    assert second.state.ue_covariance[0, 0] > first.state.ue_covariance[0, 0]


def test_a_missing_control_is_counted_and_the_set_used_without_doppler(
    snapshots: list[Snapshot],
) -> None:
    filtering = FilterSession(PARAMETERS)
    first = snapshots[0]
    assert list(filtering.add_measurements(first.stamp_ns, first.measurements)) == []
    assert filtering.pending == 1
    (output,) = filtering.flush()
    assert filtering.problems["missing_control"] == 1
    assert output.control == Control(0.0, 0.0)
    # As if Doppler had not been measured at all.
    values = first.measurements.values.copy()
    values[:, DOPPLER] = math.nan
    silent = MeasurementSet(values, first.measurements.covariances)
    expected = stepped(initial_posterior(PARAMETERS), silent, [], 0.0)
    np.testing.assert_array_equal(output.state.density.mean, expected.density.mean)
    with_it = stepped(initial_posterior(PARAMETERS), first.measurements, [], 22.22)
    assert not np.array_equal(output.state.ue_mean, with_it.ue_mean)


def test_a_path_of_doppler_alone_is_left_out_at_an_unknown_speed() -> None:
    values = np.full((2, DIM), math.nan)
    values[0, DOPPLER] = 3.0
    values[1, :3] = [380.0, 0.3, 0.1]
    filtering = FilterSession(PARAMETERS)
    list(filtering.add_measurements(10**9, MeasurementSet(values, np.zeros((2, DIM, DIM)))))
    (output,) = filtering.flush()
    assert output.associations.ids.shape[1] == 1
    assert np.isfinite(output.state.density.mean).all()


def test_a_run_played_again_begins_anew() -> None:
    """The second round gives the bytes of the first; that it began is counted."""
    once, again = FilterSession(PARAMETERS), FilterSession(PARAMETERS)
    run = list(simulate(SCENARIO, np.random.default_rng(3)))
    first = feed_all(once, run)
    rounds = feed_all(again, [*run, *run])
    assert len(rounds) == 2 * len(first) and again.problems == {"reset_backward_jump": 1}
    for ours, theirs in zip(rounds[len(first) :], first, strict=True):
        np.testing.assert_array_equal(ours.state.density.mean, theirs.state.density.mean)
        np.testing.assert_array_equal(
            ours.state.density.covariance, theirs.state.density.covariance
        )


def feed_all(filtering: FilterSession, run: list[Snapshot]) -> list[FilterOutput]:
    outputs: list[FilterOutput] = []
    for s in run:
        outputs += filtering.add_control(s.stamp_ns, s.control.speed, s.control.turn_rate)
        outputs += filtering.add_measurements(s.stamp_ns, s.measurements)
    return outputs + list(filtering.end())


def test_a_gap_without_sets_is_predicted_through(snapshots: list[Snapshot]) -> None:
    """30 s of odometry alone: the covariance grows by the process noise of that time."""
    filtering = FilterSession(PARAMETERS)
    before = feed_all(filtering, snapshots[:10])[-1]
    stamp, control = before.stamp_ns, snapshots[9].control
    for tick in range(1, 61):
        list(filtering.add_control(stamp + tick * 500_000_000, *control))
    nothing = MeasurementSet(np.zeros((0, DIM)), np.zeros((0, DIM, DIM)))
    (after,) = filtering.add_measurements(stamp + 30_000_000_000, nothing)
    spans = span_rows([ControlSpan(control, 0.5)] * 60)
    _, jacobian, noise = propagate_spans(before.state.ue_mean, spans, PARAMETERS.noise_rate)
    expected = jacobian @ before.state.ue_covariance @ jacobian.T + noise
    np.testing.assert_allclose(after.state.ue_covariance, expected, rtol=1e-6)
    assert after.state.ue_covariance[0, 0] > before.state.ue_covariance[0, 0]


def test_missing_controls_are_bridged_with_an_honest_covariance() -> None:
    """A fifth of the controls is lost in bursts, at a vehicle that varies its speed.

    NEES of the vehicle over 8 runs of 80 steps; 4 where the covariance is honest. Without the
    noise for old controls it is several times that.
    """
    scenario = load_scenario("figure_eight")
    parameters = filter_parameters_for(scenario)
    trusting = replace(parameters, coasting_acceleration=0.0, coasting_turn_acceleration=0.0)
    nees: dict[str, list[float]] = {"inflated": [], "trusting": []}
    for seed in range(8):
        snapshots = list(simulate(scenario, np.random.default_rng([77, seed])))
        rng = np.random.default_rng(seed)
        starts = rng.choice(len(snapshots), len(snapshots) // 20, replace=False)
        lost = {int(k) for start in starts for k in range(start, start + 4)}
        for name, settings in (("inflated", parameters), ("trusting", trusting)):
            filtering = FilterSession(settings)
            for k, s in enumerate(snapshots):
                outputs: list[FilterOutput] = []
                if k not in lost or k < 2:
                    outputs += filtering.add_control(s.stamp_ns, *s.control)
                outputs += filtering.add_measurements(s.stamp_ns, s.measurements)
                nees[name] += [nees_of(o, snapshots) for o in outputs]
            assert filtering.problems["numerical_failure"] == 0
    # Its speed jumps by 8 m/s, more than the model foresees, so not quite 4.
    assert 3.0 < np.mean(nees["inflated"]) < 9.0
    assert np.mean(nees["trusting"]) > 10.0 * np.mean(nees["inflated"])


def nees_of(output: FilterOutput, snapshots: list[Snapshot]) -> float:
    (truth,) = (s.state for s in snapshots if s.stamp_ns == output.stamp_ns)
    error = output.state.ue_mean - truth
    error[2] = math.remainder(error[2], 2.0 * math.pi)
    return float(error @ np.linalg.solve(output.state.ue_covariance, error))


def test_late_and_duplicate_sets_are_refused_and_leave_the_state(
    snapshots: list[Snapshot],
) -> None:
    filtering = FilterSession(PARAMETERS)
    for s in snapshots[:3]:
        list(filtering.add_control(s.stamp_ns, s.control.speed, s.control.turn_rate))
        assert len(list(filtering.add_measurements(s.stamp_ns, s.measurements))) == 1
    before = filtering.state
    for s in snapshots[:3]:
        with pytest.raises(Refused) as caught:
            list(filtering.add_measurements(s.stamp_ns, s.measurements))
        last = s is snapshots[2]
        assert caught.value.reason == ("duplicate_stamp" if last else "late")
    with pytest.raises(Refused) as caught:
        list(filtering.add_control(s.stamp_ns, math.nan, 0.0))
    assert caught.value.reason == "invalid_control"
    assert filtering.state is before


Failure = Any


def broken(kind: str) -> Failure:
    def fails(*arguments: Any) -> Any:
        if kind == "raises":
            raise np.linalg.LinAlgError("not positive definite")
        state, associations = step(*arguments)
        best = state.density
        mean, covariance = best.mean.copy(), best.covariance.copy()
        if kind == "nan mean":
            mean[1] = math.nan
        elif kind == "infinite covariance":
            covariance[0, 1] = math.inf
        elif kind == "negative variance":
            covariance[5, 5] *= -1.0
        elif kind == "asymmetric covariance":
            covariance[0, 1] += 1e-3
        else:
            assert kind == "indefinite covariance"
            covariance[0, 1] = covariance[1, 0] = 1.01 * np.sqrt(
                covariance[0, 0] * covariance[1, 1]
            )
        broken_one = best.but(mean=mean, covariance=covariance)
        return replace(state, densities=(broken_one,)), associations

    return fails


@pytest.mark.parametrize(
    "kind",
    [
        "raises",
        "nan mean",
        "infinite covariance",
        "negative variance",
        "asymmetric covariance",
        "indefinite covariance",
    ],
)
def test_a_numerical_failure_keeps_the_last_good_state(
    snapshots: list[Snapshot], monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    filtering = FilterSession(PARAMETERS)

    def feed(s: Snapshot) -> Iterator[FilterOutput]:
        list(filtering.add_control(s.stamp_ns, s.control.speed, s.control.turn_rate))
        yield from filtering.add_measurements(s.stamp_ns, s.measurements)

    for s in snapshots[:3]:
        assert len(list(feed(s))) == 1
    good = filtering.state
    with monkeypatch.context() as patch:
        patch.setattr(recovery_module, "step", broken(kind))
        assert list(feed(snapshots[3])) == []
        assert list(feed(snapshots[4])) == []
    assert filtering.state is good
    assert filtering.problems["numerical_failure"] == 2
    # The next step makes up for all of the motion since.
    (output,) = feed(snapshots[5])
    spans = [ControlSpan(snapshots[k].control, SCENARIO.period) for k in (2, 3, 4)]
    expected = stepped(good, snapshots[5].measurements, spans, 22.22)
    np.testing.assert_array_equal(output.state.density.mean, expected.density.mean)
    assert filtering.problems["numerical_failure"] == 2
    # And the one after that starts from there again.
    (output,) = feed(snapshots[6])
    span = [ControlSpan(snapshots[5].control, SCENARIO.period)]
    after = stepped(expected, snapshots[6].measurements, span, 22.22)
    np.testing.assert_array_equal(output.state.density.mean, after.density.mean)


def test_an_infinite_covariance_from_the_sensor_cannot_reach_the_state() -> None:
    huge = np.tile(np.diag([1e300, 1e300, 1e300, 1e300, 1e300, 1e300]), (1, 1, 1))
    values: FloatArray = np.array([[381.0, 1.5, 0.5, 0.1, -0.5, 0.0]])
    filtering = FilterSession(with_doppler_std(PARAMETERS, 0.1))
    list(filtering.add_control(10**9, 22.22, 0.3))
    for _ in filtering.add_measurements(10**9, MeasurementSet(values, huge)):
        pass
    assert np.isfinite(filtering.state.density.mean).all()
    assert np.isfinite(filtering.state.density.covariance).all()


@pytest.mark.parametrize("component", range(DIM))
def test_a_component_that_is_never_measured_is_no_trouble(
    snapshots: list[Snapshot], component: int
) -> None:
    filtering = FilterSession(PARAMETERS)
    for s in snapshots:
        values = s.measurements.values.copy()
        values[:, component] = math.nan
        list(filtering.add_control(s.stamp_ns, s.control.speed, s.control.turn_rate))
        measurements = MeasurementSet(values, s.measurements.covariances)
        (output,) = filtering.add_measurements(s.stamp_ns, measurements)
        error = output.state.ue_mean - s.state
        assert np.hypot(error[0], error[1]) < 4.0
    assert not filtering.problems


@pytest.mark.parametrize("settings", [{}, {"coupling": "marginal"}, {"density": "pmbm"}], ids=str)
def test_the_covariance_stays_one(settings: dict[str, Any]) -> None:
    """Symmetric to the last bit and positive definite after each of 400 steps, as NumPy sees it.

    ``dopslam bench --only memory`` looks at 100,000.
    """
    parameters = filter_parameters_for(SCENARIO, **settings)
    # Without process noise the vehicle stays on its circle, however often it goes round.
    endless = replace(SCENARIO, controls=SCENARIO.controls * 10, process_noise_std=(0.0,) * 4)
    filtering, steps = FilterSession(parameters), 0
    for s in simulate(endless, np.random.default_rng(7)):
        list(filtering.add_control(s.stamp_ns, s.control.speed, s.control.turn_rate))
        for output in filtering.add_measurements(s.stamp_ns, s.measurements):
            steps += 1
            for one in output.state.densities:
                deviation = np.sqrt(np.diagonal(one.covariance))
                correlation = one.covariance / np.outer(deviation, deviation)
                assert np.array_equal(one.covariance, one.covariance.T)
                assert np.linalg.eigvalsh(correlation)[0] > 1e-6
    assert steps == 400 and not filtering.problems
