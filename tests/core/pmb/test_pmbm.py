"""The PMBM: several global hypotheses carried, and what they say together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dopslam_ros.core.linalg.arrays import FloatArray
from dopslam_ros.core.models.measurements import MeasurementSet
from dopslam_ros.core.models.motion import ControlSpan
from dopslam_ros.core.pmb import (
    Density,
    FilterParameters,
    Posterior,
    initial_density,
    initial_posterior,
    prepare,
    step,
)
from dopslam_ros.core.pmb.coordinates_kernels import components_in_space
from dopslam_ros.core.pmb.inactive_grid import InactiveGrid
from dopslam_ros.core.pmb.posterior import all_ids
from dopslam_ros.core.settings.model import with_doppler_std
from dopslam_ros.lab.study.plan import run_generator
from dopslam_ros.simulation.matched import filter_parameters_for
from dopslam_ros.simulation.scenario import load_scenario
from dopslam_ros.simulation.simulator import Snapshot, simulate

# Without Doppler and with much clutter, so that the filter doubts.
SCENARIO = replace(with_doppler_std(load_scenario("paper"), None), clutter_mean=4.0)
PMBM = filter_parameters_for(SCENARIO, density="pmbm")
Inputs = list[tuple[MeasurementSet, list[ControlSpan], float]]


@pytest.fixture(scope="module")
def inputs() -> Inputs:
    """The sets of a run, the spans before each and the speed."""
    found: Inputs = []
    before: Snapshot | None = None
    for snapshot in simulate(SCENARIO, run_generator(3, 0)):
        spans = [ControlSpan(before.control, SCENARIO.period)] if before else []
        found.append((snapshot.measurements, spans, snapshot.control.speed))
        before = snapshot
    return found


def run(inputs: Inputs, parameters: FilterParameters) -> list[Posterior]:
    state, states = initial_posterior(parameters), []
    for measurements, spans, speed in inputs:
        state = step(state, prepare(measurements, parameters), spans, speed, parameters)[0]
        states.append(state)
    return states


def mixture_of(densities: list[Density], weight: FloatArray) -> Posterior:
    """Several hypotheses that have nothing out of view."""
    return Posterior(tuple(densities), (InactiveGrid(),) * len(densities), weight)


def test_the_pmb_is_a_mixture_of_one(inputs: Inputs) -> None:
    for state in run(inputs[:8], filter_parameters_for(SCENARIO)):
        assert len(state.densities) == len(state.inactive) == 1 and state.weight.tolist() == [1.0]
        np.testing.assert_allclose(state.ue_mean, state.density.ue_mean, rtol=1e-15)
        np.testing.assert_array_equal(state.ue_covariance, state.density.ue_covariance)


def test_with_one_association_and_one_hypothesis_both_densities_are_the_same(
    inputs: Inputs,
) -> None:
    settings = {"gamma": 1, "hypotheses_kept": 1}
    pmbm = run(inputs, replace(PMBM, **settings))
    pmb = run(inputs, filter_parameters_for(SCENARIO, **settings))
    for one, other in zip(pmbm, pmb, strict=True):
        np.testing.assert_allclose(one.density.mean, other.density.mean, rtol=0, atol=1e-7)
        np.testing.assert_allclose(one.density.covariance, other.density.covariance, atol=1e-7)
        np.testing.assert_array_equal(one.density.track_id, other.density.track_id)


def test_weights_sum_to_one_are_sorted_pruned_and_capped(inputs: Inputs) -> None:
    parameters = replace(PMBM, hypotheses_kept=4, prune_hypothesis=0.01)
    counts = []
    for mixture in run(inputs, parameters):
        counts.append(len(mixture.weight))
        assert mixture.weight.sum() == pytest.approx(1.0)
        assert (np.diff(mixture.weight) <= 0.0).all()
        assert (mixture.weight > 0.01).all()
        assert len(mixture.densities) == counts[-1] <= 4
        assert all(np.isfinite(one.mean).all() for one in mixture.densities)
    assert max(counts) > 1, "the scene must make the filter doubt"


def test_global_hypotheses_share_the_ids_of_their_births(inputs: Inputs) -> None:
    """The same path gives a landmark of the same id and place in every hypothesis."""
    for mixture in run(inputs[:6], PMBM):
        places: dict[int, list[FloatArray]] = {}
        for one in mixture.densities:
            assert one.next_id == mixture.density.next_id
            for track, kind, place in zip(
                one.component_track, one.component_type, components_in_space(one)[0], strict=True
            ):
                key = 10 * int(one.track_id[track]) + int(kind)
                places.setdefault(key, []).append(place)
        for same in places.values():
            assert np.ptp(np.array(same), axis=0).max() < 60.0
        each = map(all_ids, mixture.densities, mixture.inactive)
        np.testing.assert_array_equal(
            mixture.track_ids, sorted({int(i) for ids in each for i in ids})
        )


def test_a_set_judges_the_hypotheses(inputs: Inputs) -> None:
    """Of two positions of the vehicle the one that foresees the set wins."""
    measurements, _, speed = inputs[0]
    right = initial_density(PMBM)
    wrong = moved(right, [8.0, 0.0, 0.0, 0.0])
    before = mixture_of([wrong, right], np.array([0.9, 0.1]))
    after, _ = step(before, prepare(measurements, PMBM), [], speed, PMBM)
    assert np.linalg.norm(after.density.ue_mean[:2] - right.ue_mean[:2]) < 2.0
    assert after.weight[0] > 0.5


def test_the_associations_speak_of_the_likeliest_hypothesis_and_of_all(inputs: Inputs) -> None:
    """The innovation is that of the hypothesis that wins, the evidence the sum over all."""
    measurements, _, speed = inputs[0]
    right = initial_density(PMBM)
    wrong = moved(right, [1.0, 0.0, 0.0, 0.0])
    observed, pmb = prepare(measurements, PMBM), replace(PMBM, density="pmb")
    alone = [
        step(mixture_of([one], np.ones(1)), observed, [], speed, pmb)[1] for one in (wrong, right)
    ]
    prior = np.array([0.2, 0.8])
    _, both = step(mixture_of([wrong, right], prior), observed, [], speed, PMBM)
    assert alone[0].nis != alone[1].nis
    assert both.log_evidence == pytest.approx(
        np.logaddexp(*(np.log(prior) + [one.log_evidence for one in alone]))
    )
    assert (both.nis, both.nis_dof) == (alone[1].nis, alone[1].nis_dof)
    assert both.nis_dof > 0


def test_moments_of_the_vehicle_are_those_of_a_sample() -> None:
    rng = np.random.default_rng(5)
    states = [moved(initial_density(PMBM), [d, -d, d / 50.0, 2.0 * d]) for d in (0.0, 1.0)]
    states = [moved(one, [0.0, 0.0, np.pi / 2.0, 0.0]) for one in states]  # about +-180 degrees
    mixture = mixture_of(states, np.array([0.7, 0.3]))
    which = rng.random(200_000) < 0.3
    draws = np.where(
        which[:, None],
        rng.multivariate_normal(states[1].ue_mean, states[1].ue_covariance, 200_000),
        rng.multivariate_normal(states[0].ue_mean, states[0].ue_covariance, 200_000),
    )
    difference = mixture.ue_mean - draws.mean(axis=0)
    difference[2] = np.angle(np.exp(1j * difference[2]))
    np.testing.assert_allclose(difference, 0.0, atol=0.01)
    np.testing.assert_allclose(mixture.ue_covariance, np.cov(draws.T), rtol=0.02, atol=2e-4)
    assert abs(mixture.ue_mean[2]) <= np.pi


def moved(state: Density, offset: list[float]) -> Density:
    mean = state.mean.copy()
    mean[:4] += offset
    return state.but(mean=mean)
