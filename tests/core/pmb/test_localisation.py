"""Localisation on a known map: the consider update against textbook algebra, and honesty."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dopslam_ros.core.linalg.arrays import IntArray
from dopslam_ros.core.linalg.jit import from_python
from dopslam_ros.core.models.motion import ControlSpan
from dopslam_ros.core.pmb import (
    Density,
    FilterParameters,
    Posterior,
    initial_density,
    initial_posterior,
    prepare,
    step,
    step_kernels,
)
from dopslam_ros.core.pmb import localisation as localise_kernels
from dopslam_ros.core.pmb import update as update_kernels
from dopslam_ros.core.pmb.known_map import map_of, with_map
from dopslam_ros.core.pmb.likelihood import Likelihoods, Observed
from dopslam_ros.core.pmb.posterior import posterior_of
from dopslam_ros.core.pmb.step import advance
from dopslam_ros.core.pmb.update import Linearised, Updated
from dopslam_ros.core.settings.layout import VEHICLE
from dopslam_ros.simulation.matched import filter_parameters_for
from dopslam_ros.simulation.scenario import Scenario, load_scenario
from dopslam_ros.simulation.simulator import Snapshot, simulate

consider = from_python(localise_kernels.consider)
associate_paths = from_python(step_kernels.associate_paths)
_condition = from_python(update_kernels.condition)

SCENARIO = load_scenario("paper")
PARAMETERS = filter_parameters_for(SCENARIO)
KNOWN = replace(PARAMETERS, mapping=False)
# The size of the vehicle's block.
UE = len(VEHICLE)


def condition(state: Density, fit: Likelihoods, observed: Observed, source: IntArray) -> Updated:
    """The update of a density about its mean."""
    about = Linearised(state.mean, state.vehicle, state.start, fit, observed)
    return _condition(about, state.covariance, source)


def run(
    scenario: Scenario, seed: int, state: Posterior, parameters: FilterParameters
) -> list[tuple[Snapshot, Posterior]]:
    """The filter over a simulated run."""
    spans: list[ControlSpan] = []
    outcome = []
    for snapshot in simulate(scenario, np.random.default_rng(seed)):
        speed = snapshot.control.speed
        observed = prepare(snapshot.measurements, parameters)
        state, _ = step(state, observed, spans, speed, parameters)
        spans = [ControlSpan(snapshot.control, scenario.period)]
        outcome.append((snapshot, state))
    return outcome


@pytest.fixture(scope="module")
def learned() -> Posterior:
    """The density at the end of a run of the paper's scene."""
    return run(SCENARIO, 3, initial_posterior(PARAMETERS), PARAMETERS)[-1][1]


def in_map_of(known: Posterior) -> Posterior:
    """The vehicle at the start, in a map that was learned before."""
    density = with_map(initial_density(KNOWN), known.density, KNOWN)
    return posterior_of(density, known.inactive[0])


def test_a_map_keeps_its_own_correlations_and_loses_the_vehicle(learned: Posterior) -> None:
    known = learned.density
    bare = map_of(known)
    assert not bare.mean[:UE].any()
    assert not bare.covariance[:UE].any()
    moved = with_map(initial_density(PARAMETERS), bare, PARAMETERS)
    np.testing.assert_array_equal(moved.ue_covariance, PARAMETERS.initial_covariance)
    assert not moved.covariance[:UE, UE:].any()
    np.testing.assert_array_equal(moved.covariance[UE:, UE:], known.covariance[UE:, UE:])
    assert np.abs(moved.covariance[UE : UE + 3, UE + 3 : UE + 6]).max() > 0.0
    apart = with_map(known, bare, replace(PARAMETERS, coupling="marginal"))
    assert not apart.covariance[UE : UE + 3, UE + 3 : UE + 6].any()


def test_the_update_is_schmidts(learned: Posterior) -> None:
    """Gains by the textbook's K = P H' S^-1, the rows of the map zeroed, in Joseph's form."""
    snapshot = next(simulate(SCENARIO, np.random.default_rng(8)))
    speed = snapshot.control.speed
    state = advance(in_map_of(learned), [], KNOWN).density
    observed = prepare(snapshot.measurements, KNOWN)
    association = associate_paths(state, observed, speed, KNOWN.constants)
    best = association.hypotheses
    source, fit, n = best.source[:1], association.likelihoods, len(state.mean)
    assert (source >= 0).sum() > 3
    jacobian, innovation, noise = [], [], []
    for path, m in enumerate(source[0].tolist()):
        if m < 0:
            continue
        h = np.zeros((6, n))
        h[:, :UE] = fit.ue_jacobian[m]
        if m > 0:
            column = UE + 3 * (m - 1)
            h[:, column : column + 3] = fit.landmark_jacobian[m]
        jacobian.append(h)
        innovation.append(fit.innovation[m, path])
        noise.append(observed.noise[path])
    h, r = np.vstack(jacobian), np.zeros((6 * len(noise), 6 * len(noise)))
    for k, block in enumerate(noise):
        r[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] = block
    s = h @ state.covariance @ h.T + r
    gain = state.covariance @ h.T @ np.linalg.inv(s)
    gain[UE:] = 0.0
    rest = np.eye(n) - gain @ h
    joseph = rest @ state.covariance @ rest.T + gain @ r @ gain.T
    mean = state.mean + gain @ np.concatenate(innovation)

    updated = condition(state, fit, observed, source)
    after = consider(state, updated, np.ones(1), True)
    np.testing.assert_allclose(after.mean, mean, atol=1e-9)
    np.testing.assert_allclose(after.covariance, joseph, atol=1e-9)


def test_the_merge_over_hypotheses_matches_the_moments(learned: Posterior) -> None:
    snapshot = next(simulate(SCENARIO, np.random.default_rng(9)))
    state = advance(in_map_of(learned), [], KNOWN).density
    observed = prepare(snapshot.measurements, KNOWN)
    association = associate_paths(state, observed, snapshot.control.speed, KNOWN.constants)
    source, before = association.hypotheses.source, state
    assert len(source) > 2
    weight = np.linspace(1.0, 2.0, len(source))
    weight /= weight.sum()
    updated = condition(state, association.likelihoods, observed, source)
    each = [
        consider(
            before,
            condition(state, association.likelihoods, observed, source[h : h + 1]),
            np.ones(1),
            True,
        )
        for h in range(len(source))
    ]
    mean = sum(w * one.mean for w, one in zip(weight, each, strict=True))
    covariance = sum(
        w * (one.covariance + np.outer(one.mean - mean, one.mean - mean))
        for w, one in zip(weight, each, strict=True)
    )
    merged = consider(before, updated, weight, True)
    np.testing.assert_allclose(merged.mean, mean, atol=1e-12)
    np.testing.assert_allclose(merged.covariance, covariance, atol=1e-12)
    assert np.linalg.eigvalsh(merged.covariance).min() > 0.0


def test_nothing_is_born_and_no_byte_of_the_map_in_view_changes() -> None:
    """Walls only, so that nothing becomes inactive: the map's block stays bit by bit."""
    walls = replace(
        SCENARIO,
        landmarks=SCENARIO.landmarks[SCENARIO.landmark_types == 1],
        landmark_types=SCENARIO.landmark_types[SCENARIO.landmark_types == 1],
    )
    first = run(walls, 4, initial_posterior(PARAMETERS), PARAMETERS)[-1][1]
    before = in_map_of(first)
    start, end = before.density, run(walls, 5, before, KNOWN)[-1][1].density
    for name in ("origin", "axes", "component_weight", "track_id", "existence"):
        assert getattr(end, name).tobytes() == getattr(start, name).tobytes(), name
    assert end.mean[UE:].tobytes() == start.mean[UE:].tobytes()
    assert end.covariance[UE:, UE:].tobytes() == start.covariance[UE:, UE:].tobytes()
    assert end.undetected.viewpoints.tobytes() == start.undetected.viewpoints.tobytes()
    assert end.undetected.looks == start.undetected.looks and end.next_id == start.next_id
    assert end.ue_covariance[0, 0] < PARAMETERS.initial_std[0] ** 2
    assert np.abs(end.covariance[:UE, UE:]).max() > 0.0


def test_the_covariance_is_honest_on_maps_of_earlier_runs() -> None:
    """NEES of the vehicle over 60 pairs of runs, each with a map of its own.

    The mean over the runs of the mean over the steps; ideal is 4. Steps of a run depend on each
    other, so the limits come from the spread over the runs, not from a chi-square.
    """
    nees, sideways = [], []
    for seed in range(60):
        first = run(SCENARIO, 1000 + seed, initial_posterior(PARAMETERS), PARAMETERS)[-1][1]
        outcome = run(SCENARIO, 5000 + seed, in_map_of(first), KNOWN)
        errors = np.array([state.ue_mean - truth.state for truth, state in outcome])
        errors[:, 2] = np.angle(np.exp(1j * errors[:, 2]))
        covariances = np.array([state.ue_covariance for _, state in outcome])
        whitened = np.linalg.solve(covariances, errors[:, :, None])[:, :, 0]
        nees.append(float(np.mean(np.sum(errors * whitened, axis=1))))
        sideways.append(float(np.mean(np.sum(errors[:, :2] ** 2, axis=1))))
    deviation = float(np.std(nees) / np.sqrt(len(nees)))
    print(f"NEES {np.mean(nees):.2f} +- {deviation:.2f}, RMSE {np.sqrt(np.mean(sideways)):.3f} m")
    assert abs(np.mean(nees) - 4.0) < 4.0 * deviation + 0.3
