"""The simulator: repeatable, and its draws as frequent and as wide as the scenario says."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from dopslam_ros.core.linalg.arrays import BoolArray, wrap_angle
from dopslam_ros.core.models.channel import observe, residual
from dopslam_ros.core.models.motion import Control, propagate
from dopslam_ros.core.settings.layout import DIM, LandmarkType
from dopslam_ros.core.settings.model import clutter_box, with_doppler_std
from dopslam_ros.simulation.scenario import Blockage, Scenario, load_scenario
from dopslam_ros.simulation.simulator import (
    CLUTTER,
    Snapshot,
    all_landmarks,
    nominal_trajectory,
    simulate,
    visible,
)


def run(scenario: Scenario, seed: int) -> list[Snapshot]:
    return list(simulate(scenario, np.random.default_rng(seed)))


def bytes_of(snapshots: list[Snapshot]) -> bytes:
    return b"".join(
        s.state.tobytes() + s.measurements.values.tobytes() + s.sources.tobytes() for s in snapshots
    )


def many(scenario: Scenario, runs: int) -> list[Snapshot]:
    return [snapshot for seed in range(runs) for snapshot in run(scenario, seed)]


def test_the_same_seed_is_the_same_run_bit_for_bit() -> None:
    scenario = load_scenario("paper")
    assert bytes_of(run(scenario, 5)) == bytes_of(run(scenario, 5))


def test_another_seed_is_another_run() -> None:
    scenario = load_scenario("paper")
    one, other = run(scenario, 5), run(scenario, 6)
    assert not np.array_equal(one[0].state, other[0].state)
    assert bytes_of(one) != bytes_of(other)


def test_dropping_a_component_leaves_everything_else_as_it_was() -> None:
    scenario = load_scenario("paper")
    with_it, without = run(scenario, 5), run(with_doppler_std(scenario, None), 5)
    for one, other in zip(with_it, without, strict=True):
        np.testing.assert_array_equal(one.state, other.state)
        np.testing.assert_array_equal(one.sources, other.sources)
        full, less = one.measurements.values, other.measurements.values
        np.testing.assert_array_equal(full[:, :5], less[:, :5])
        assert np.isnan(less[:, 5]).all() and np.isfinite(full).all()


def test_snapshots_carry_time_and_control() -> None:
    scenario = load_scenario("paper")
    snapshots = run(scenario, 1)
    assert [s.step for s in snapshots] == list(range(40))
    assert {b.stamp_ns - a.stamp_ns for a, b in itertools.pairwise(snapshots)} == {500_000_000}
    assert {s.control for s in snapshots} == {Control(22.22, 0.3141592653589793)}


def test_misdetections_are_as_frequent_as_they_should_be() -> None:
    scenario = load_scenario("paper")
    possible = seen = 0
    for snapshot in many(scenario, 60):
        inside = visible(scenario, snapshot.state, snapshot.step)
        detected = np.isin(np.arange(9), snapshot.sources)
        assert not (detected & ~inside).any()
        possible += int(inside.sum())
        seen += int(detected.sum())
    assert possible > 12_000
    deviation = (seen - 0.9 * possible) / math.sqrt(possible * 0.9 * 0.1)
    assert abs(deviation) < 4.0


def test_clutter_is_poisson_and_uniform_over_its_box() -> None:
    scenario = replace(load_scenario("paper"), clutter_mean=2.5)
    snapshots = many(scenario, 60)
    counts = np.array([(s.sources == CLUTTER).sum() for s in snapshots])
    n = len(counts)
    assert counts.mean() == pytest.approx(2.5, abs=4.0 * math.sqrt(2.5 / n))
    # Index of dispersion: a Poisson's variance is its mean.
    dispersion = ((counts - counts.mean()) ** 2).sum() / counts.mean()
    assert chi2.ppf(1e-4, n - 1) < dispersion < chi2.ppf(1.0 - 1e-4, n - 1)
    values = np.vstack([s.measurements.values[s.sources == CLUTTER] for s in snapshots])
    box = clutter_box(scenario)
    share = (values - box[:, 0]) / (box[:, 1] - box[:, 0])
    assert share.min() >= 0.0 and share.max() <= 1.0
    for component in range(DIM):
        histogram, _ = np.histogram(share[:, component], 20, (0.0, 1.0))
        expected = len(values) / 20
        assert ((histogram - expected) ** 2).sum() / expected < chi2.ppf(1.0 - 1e-5, 19)


def test_the_measurement_noise_has_its_standard_deviations() -> None:
    scenario = load_scenario("paper")
    positions, types = all_landmarks(scenario)
    noise = []
    for snapshot in many(scenario, 30):
        real = snapshot.sources != CLUTTER
        paths = observe(snapshot.state, snapshot.control.speed, positions, types, scenario.bs)
        expected = paths.mean[snapshot.sources[real]]
        noise.append(residual(snapshot.measurements.values[real], expected))
    scaled = np.vstack(noise) / scenario.measurement_noise_std
    n = len(scaled)
    square = (scaled**2).sum(axis=0)
    assert np.all(square > chi2.ppf(1e-5, n)) and np.all(square < chi2.ppf(1.0 - 1e-5, n))
    assert np.all(np.abs(scaled.mean(axis=0)) < 4.5 / math.sqrt(n))
    off_diagonal = np.corrcoef(scaled.T) - np.eye(DIM)
    assert np.abs(off_diagonal).max() < 5.0 / math.sqrt(n)


def test_the_start_and_the_process_noise_have_their_standard_deviations() -> None:
    scenario = load_scenario("paper")
    starts, steps = [], []
    for seed in range(60):
        snapshots = run(scenario, seed)
        starts.append(snapshots[0].state - scenario.initial_state)
        for before, after in itertools.pairwise(snapshots):
            step = after.state - propagate(before.state, before.control, scenario.period)
            step[2] = wrap_angle(step[2])
            steps.append(step)
    for errors, std in ((starts, scenario.initial_std), (steps, scenario.process_noise_std)):
        square = (np.square(errors) / np.square(std)).sum(axis=0)
        n = len(errors)
        assert np.all(square > chi2.ppf(1e-5, n)) and np.all(square < chi2.ppf(1.0 - 1e-5, n))


def test_the_process_noise_grows_with_the_period() -> None:
    scenario = replace(load_scenario("paper"), period=2.0, clutter_mean=0.0)
    biases = [np.diff([s.state[3] for s in run(scenario, seed)]) for seed in range(40)]
    assert np.std(biases) == pytest.approx(0.2 * math.sqrt(2.0 / 0.5), rel=0.08)


def test_a_component_without_std_is_not_measured() -> None:
    scenario = load_scenario("paper")
    std = (0.1, 0.05, math.nan, 0.05, math.nan, 0.1)
    for snapshot in run(replace(scenario, measurement_noise_std=std), 3):
        values = snapshot.measurements.values
        assert np.isnan(values[:, [2, 4]]).all()
        assert np.isfinite(values[:, [0, 1, 3, 5]]).all()
        assert not snapshot.measurements.covariances.any()


def test_sets_are_shuffled() -> None:
    first = [s.sources[0] for s in many(load_scenario("paper"), 20)]
    share = np.mean(np.array(first) == 0)
    assert 0.08 < share < 0.3  # the BS is first no more often than another path
    snapshots = many(load_scenario("paper"), 2)
    assert any(np.any(np.diff(s.sources[s.sources >= 0]) < 0) for s in snapshots)


def test_azimuths_are_wrapped() -> None:
    snapshots = many(load_scenario("paper"), 9)
    azimuths = np.vstack([s.measurements.values[:, [1, 3]] for s in snapshots])
    assert np.abs(azimuths).max() <= math.pi and np.abs(azimuths).max() > 3.1


def test_scattering_points_come_into_sight_where_the_paper_sees_them() -> None:
    scenario = load_scenario("paper")
    track = nominal_trajectory(scenario)
    sight = np.array([visible(scenario, state, step) for step, state in enumerate(track)])
    assert sight[:, :5].all()
    # 35.6 m away at the nearest, in view for a while around each of the four.
    assert sight[:, 5:].sum(axis=1).max() == 1
    first = [int(np.argmax(sight[5:, 5 + k])) + 5 for k in range(1, 4)]
    # The figure drops at k = 8, 18, 28, counted from 1.
    assert sorted(first) == [7, 17, 27]


def test_what_is_blocked_has_no_path_and_all_else_is_as_before() -> None:
    scenario = replace(load_scenario("paper"), detection_probability=1.0)
    # The BS at 2 ... 3.5 s, SP 5 (in view at the start) from the start to 1 s: two snapshots.
    hidden = replace(
        scenario,
        blocked=(Blockage(0, 2.0, 4.0), Blockage(5, 0.0, 1.0)),
    )
    for free, less in zip(run(scenario, 8), run(hidden, 8), strict=True):
        gone = {0} if 4 <= free.step < 8 else {5} if free.step < 2 else set()
        assert gone <= set(free.sources.tolist())
        np.testing.assert_array_equal(free.state, less.state)
        keep = ~np.isin(free.sources, list(gone))

        def rows(snapshot: Snapshot, keep: BoolArray) -> list[list[float]]:
            table = np.column_stack([snapshot.sources, snapshot.measurements.values])
            return sorted(table[keep].tolist())

        assert rows(free, keep) == rows(less, np.ones(len(less.sources), dtype=bool))


SINGULAR = {
    "under the BS": (0.0, 0.0, 0.0, 300.0),
    "under an SP": (99.0, 0.0, 0.0, 300.0),
    "on a wall": (100.0, 0.0, 0.0, 300.0),
    "behind a wall": (120.0, 0.0, 0.0, 300.0),
}


@pytest.mark.parametrize("name", list(SINGULAR))
def test_singular_geometry_is_not_detected_and_never_nan(name: str) -> None:
    scenario = load_scenario("paper")
    scenario = replace(
        scenario,
        initial_state=SINGULAR[name],
        initial_std=(1e-9,) * 4,
        process_noise_std=(0.0,) * 4,
        detection_probability=1.0,
        controls=(Control(0.0, 0.0),) * 3,
        landmarks=np.vstack([scenario.landmarks, scenario.bs, scenario.bs]),
        landmark_types=np.append(scenario.landmark_types, [LandmarkType.VA, LandmarkType.SP]),
    )
    for snapshot in run(scenario, 1):
        assert np.isfinite(snapshot.measurements.values).all()
        assert not np.isin([9, 10], snapshot.sources).any()
        gone = {"under the BS": 0, "under an SP": 5, "on a wall": 1, "behind a wall": 1}[name]
        assert gone not in snapshot.sources
        assert 2 in snapshot.sources


def test_a_scene_without_landmarks_or_clutter_has_the_bs_only() -> None:
    scenario = replace(
        load_scenario("paper"),
        landmarks=np.zeros((0, 3)),
        landmark_types=np.zeros(0, dtype=np.int64),
        clutter_mean=0.0,
        detection_probability=1.0,
    )
    assert all(s.sources.tolist() == [0] for s in run(scenario, 1))


def test_the_nominal_trajectory_is_the_circle_of_the_paper() -> None:
    states = nominal_trajectory(load_scenario("paper"))
    assert states.shape == (40, 4)
    np.testing.assert_allclose(np.hypot(states[:, 0], states[:, 1]), 70.7285, atol=1e-3)
    np.testing.assert_array_equal(states[:, 3], 300.0)
    once_round = propagate(states[-1], Control(22.22, 0.3141592653589793), 0.5)
    np.testing.assert_allclose(once_round, states[0], atol=1e-9)
