"""The step against one written down from the equations with loops: tests/textbook.py.

Both get the same inputs and go on from their own results. In exact arithmetic they are equal. They
round in another order, which leaves up to 1e-9, of a standard deviation, a probability or a weight,
after 15 steps. 1e-7 is asked: nothing wrong in a formula, a sign or a decision is that small.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import fields, replace
from typing import NamedTuple

import numpy as np
import pytest
import textbook

from dopslam_ros.core.linalg.arrays import FloatArray, wrap_angle
from dopslam_ros.core.models.measurements import MeasurementSet
from dopslam_ros.core.models.motion import Control, ControlSpan
from dopslam_ros.core.pmb import (
    Associations,
    FilterParameters,
    Posterior,
    initial_posterior,
    prepare,
    step,
)
from dopslam_ros.core.settings.layout import DIM, NONE
from dopslam_ros.simulation.matched import filter_parameters_for
from dopslam_ros.simulation.scenario import Scenario, load_scenario
from dopslam_ros.simulation.simulator import simulate

STEPS = 15
TOLERANCE = 1e-7
NAN = math.nan
# Scattering points beside a small circle, out of view from its other side.
CIRCLES = {
    "controls": (Control(22.22, math.pi / 3.0),) * STEPS,
    "sp_field_of_view": 35.0,
    "landmarks": np.array(
        [
            [200.0, 0.0, 40.0],
            [0.0, 200.0, 40.0],
            [95.0, 0.0, 10.0],
            [90.0, 15.0, 4.0],
            [15.0, 25.0, 8.0],
            [90.0, -15.0, 12.0],
        ]
    ),
    "landmark_types": np.array([1, 1, 2, 2, 2, 2]),
}
SCENES: dict[str, dict[str, object]] = {
    "paper": {},
    "without Doppler": {"measurement_noise_std": (0.1, 0.05, 0.05, 0.05, 0.05, NAN)},
    "much clutter": {"clutter_mean": 10.0},
    "many snapshots from one place": {"period": 0.1},
    "round in small circles": CIRCLES,
    "without elevations": {"measurement_noise_std": (0.1, 0.05, NAN, 0.05, NAN, 0.1)},
    "without angles of arrival": {"measurement_noise_std": (0.1, NAN, NAN, 0.05, 0.05, 0.1)},
    "few hypotheses, coarse pruning": {"gamma": 3, "prune_existence": 0.02, "prune_type": 0.05},
}


class Snapshot(NamedTuple):
    """What a step gets."""

    measurements: MeasurementSet
    spans: list[ControlSpan]
    speed: float


def inputs(scenario: Scenario, seed: int) -> list[Snapshot]:
    """A run on which the vehicle goes straight now and then; what else a set may bring with it.

    Sometimes a control comes between two snapshots, and every third path has its own covariance.
    """
    rng = np.random.default_rng([seed, 1])
    controls = [
        c._replace(turn_rate=0.0 if k % 5 == 0 else c.turn_rate)
        for k, c in enumerate(scenario.controls[:STEPS])
    ]
    scenario = replace(scenario, controls=tuple(controls))
    snapshots, before = [], None
    for snapshot in simulate(scenario, np.random.default_rng(seed)):
        spans = []
        if before is not None:
            parts = [0.4, 0.6] if snapshot.step % 4 == 0 else [1.0]
            spans = [ControlSpan(before, part * scenario.period) for part in parts]
        values, own = snapshot.measurements.values, snapshot.measurements.covariances.copy()
        for path in range(0, len(values), 3):
            own[path] = some_covariance(scenario, rng)
        both = np.isfinite(values)[:, :, None] & np.isfinite(values)[:, None, :]
        measured = MeasurementSet(values, np.where(both, own, 0.0))
        snapshots.append(Snapshot(measured, spans, snapshot.control.speed))
        before = snapshot.control
    return snapshots


def some_covariance(scenario: Scenario, rng: np.random.Generator) -> FloatArray:
    """(6, 6) about as large as the scene's noise, correlated."""
    std = np.nan_to_num(np.array(scenario.measurement_noise_std), nan=1.0)
    root = np.eye(DIM) + 0.15 * rng.standard_normal((DIM, DIM))
    return np.asarray(std[:, None] * (root @ root.T) * std)


def weights_by_ids(found: Associations) -> Counter[tuple[int | None, ...]]:
    """The weight of each association in terms of landmarks; types of them together."""
    weights: Counter[tuple[int | None, ...]] = Counter()
    for row, weight in zip(found.ids.tolist(), found.weight.tolist(), strict=True):
        weights[tuple(None if i == NONE else i for i in row)] += weight
    return weights


def compare(posterior: Posterior, density: textbook.Density) -> None:
    """Vehicle, map and their covariance, existence, types, ids; who is active in which order."""
    state = posterior.density
    assert state.next_id == density.next_id
    known = {landmark.id: landmark for landmark in density.landmarks}
    assert sorted(state.track_id.tolist()) == sorted(known)
    pairs = [(known[i], c) for i in state.track_id.tolist() for c in known[i].components]
    existence = [known[i].existence for i in state.track_id.tolist()]
    np.testing.assert_allclose(state.existence, existence, atol=TOLERANCE)
    assert state.track_id[state.component_track].tolist() == [one.id for one, _ in pairs]
    assert state.component_type.tolist() == [c.kind for _, c in pairs]
    shares = [c.weight for _, c in pairs]
    np.testing.assert_allclose(state.component_weight, shares, rtol=TOLERANCE)

    # The order of those that woke up together is of no meaning.
    index = np.array([*range(4), *(i for _, c in pairs for i in range(c.at.start, c.at.stop))])
    mean, covariance = density.mean[index], density.covariance[np.ix_(index, index)]
    std = np.sqrt(np.diagonal(covariance))
    error = state.mean - mean
    error[2] = wrap_angle(error[2])
    np.testing.assert_allclose(error / std, 0.0, atol=TOLERANCE)
    difference = (state.covariance - covariance) / np.outer(std, std)
    np.testing.assert_allclose(difference, 0.0, atol=TOLERANCE)

    expected = {one.landmark.id: one for one in density.inactive_landmarks}
    inactive = posterior.inactive[0].landmarks
    assert sorted(expected) == ([] if inactive is None else sorted(inactive.track_id.tolist()))
    for row, number in enumerate([] if inactive is None else inactive.track_id.tolist()):
        one = expected[number]
        assert inactive.existence[row] == pytest.approx(one.landmark.existence, abs=TOLERANCE)
        error = (inactive.q[row] - one.q) / np.sqrt(np.diagonal(one.covariance))
        np.testing.assert_allclose(error, 0.0, atol=TOLERANCE)


@pytest.mark.parametrize("coupling", ["joint", "marginal"])
@pytest.mark.parametrize(
    "scene, seed", [*((scene, 3) for scene in SCENES), *((scene, 4) for scene in list(SCENES)[:3])]
)
def test_the_step_is_that_of_the_textbook(scene: str, coupling: str, seed: int) -> None:
    settings = {"coupling": coupling, **SCENES[scene]}
    declared = {field.name for field in fields(Scenario)}
    models = {name: settings.pop(name) for name in list(settings) if name in declared}
    scenario = replace(load_scenario("paper"), **models)
    parameters: FilterParameters = filter_parameters_for(scenario, **settings)
    state, density = initial_posterior(parameters), textbook.start(parameters)
    split = reactivated = 0
    for measurements, spans, speed in inputs(scenario, seed):
        before = {one.landmark.id for one in density.inactive_landmarks}
        state, ours = step(state, prepare(measurements, parameters), spans, speed, parameters)
        density, hypotheses = textbook.textbook_step(
            density, measurements, spans, speed, parameters
        )
        weights: Counter[tuple[int | None, ...]] = Counter()
        for ids, weight in hypotheses:
            weights[ids] += weight
        found = weights_by_ids(ours)
        assert set(found) == set(weights)
        np.testing.assert_allclose(
            [found[ids] for ids in weights], list(weights.values()), atol=TOLERANCE
        )
        compare(state, density)
        split += len(hypotheses) > len(weights)
        reactivated += len(before & {landmark.id for landmark in density.landmarks})
    # The run had everything: a map, as many associations as allowed, landmarks of open type.
    assert len(density.landmarks) >= 4 and len(hypotheses) == parameters.gamma
    assert split > 0 or scene not in list(SCENES)[:3]
    assert reactivated > 2 or scene != "round in small circles"


def test_a_step_without_paths() -> None:
    parameters = FilterParameters()
    none = MeasurementSet(np.zeros((0, DIM)), np.zeros((0, DIM, DIM)))
    spans = [ControlSpan(Control(22.0, 0.3), 0.5)]
    observed = prepare(none, parameters)
    state, _ = step(initial_posterior(parameters), observed, spans, 22.0, parameters)
    start = textbook.start(parameters)
    density, hypotheses = textbook.textbook_step(start, none, spans, 22.0, parameters)
    assert hypotheses == [((), 1.0)]
    compare(state, density)
