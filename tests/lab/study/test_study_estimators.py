"""The filters of a study: what each is, and who was given what, told right."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

from dopslam_ros.core.linalg.arrays import FloatArray
from dopslam_ros.core.models.measurements import MeasurementSet
from dopslam_ros.core.models.motion import Control, propagate
from dopslam_ros.core.pmb import Associations
from dopslam_ros.core.session.filtering import FilterSession
from dopslam_ros.core.settings.layout import NONE, LandmarkType
from dopslam_ros.core.settings.parameters import ParameterError
from dopslam_ros.lab.study.estimators import Estimate, EstimatorError
from dopslam_ros.lab.study.labels import KINDS, make_estimator
from dopslam_ros.lab.study.source_tracker import SourceTracker
from dopslam_ros.simulation.matched import filter_parameters_for
from dopslam_ros.simulation.scenario import Scenario, load_scenario
from dopslam_ros.simulation.simulator import CLUTTER, Snapshot, simulate


@pytest.fixture(scope="module")
def short() -> Scenario:
    """The paper's scene, cut to a few steps."""
    scenario = load_scenario("paper")
    return replace(scenario, controls=scenario.controls[:12])


def estimates(scenario: Scenario, label: str, **settings: object) -> list[Estimate]:
    estimator = make_estimator(label, scenario, settings)
    return [estimator.step(snapshot) for snapshot in simulate(scenario, np.random.default_rng(3))]


def means(scenario: Scenario, label: str, **settings: object) -> FloatArray:
    return np.array([estimate.mean for estimate in estimates(scenario, label, **settings)])


@pytest.mark.parametrize("name", list(KINDS))
def test_each_gives_an_estimate_at_every_step(short: Scenario, name: str) -> None:
    found = estimates(short, name)
    assert len(found) == 12
    for estimate in found:
        assert estimate.mean.shape == (4,) and np.isfinite(estimate.mean).all()
        assert np.linalg.eigvalsh(estimate.covariance).min() > 0.0
        assert estimate.seconds > 0.0
        assert estimate.landmarks.positions.shape == (len(estimate.landmarks.ids), 3)
    weights = [estimate.correct_weight for estimate in found]
    if name in ("genie", "phd", "dead_reckoning"):
        assert np.isnan(weights).all()
    else:
        assert min(weights) >= 0.0 and 0.5 < max(weights) <= 1.0 + 1e-12


@pytest.mark.parametrize(
    ("label", "settings"),
    [
        ("joint", {"coupling": "joint", "density": "pmb"}),
        ("marginal", {"coupling": "marginal", "density": "pmb"}),
        ("pmbm", {"coupling": "joint", "density": "pmbm"}),
        ("pmbm:coupling=marginal", {"coupling": "marginal", "density": "pmbm"}),
        (
            "joint:gamma=1,measurement_noise_std=[.2, .1, .1, .1, .1, .2]",
            {"gamma": 1, "measurement_noise_std": (0.2, 0.1, 0.1, 0.1, 0.1, 0.2)},
        ),
        ("marginal:prune_type=1e-1", {"coupling": "marginal", "prune_type": 0.1}),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_the_filter_is_the_one_that_runs_live(
    short: Scenario, label: str, settings: dict[str, Any]
) -> None:
    session = FilterSession(filter_parameters_for(short, **settings))
    expected = []
    for snapshot in simulate(short, np.random.default_rng(3)):
        control = snapshot.control
        session_outputs = [
            *session.add_control(snapshot.stamp_ns, control.speed, control.turn_rate),
            *session.add_measurements(snapshot.stamp_ns, snapshot.measurements),
        ]
        expected += [output.state.ue_mean for output in session_outputs]
    assert means(short, label).tobytes() == np.array(expected).tobytes()


def test_settings_of_all_and_settings_of_one(short: Scenario) -> None:
    """What a label says comes before what is said for all."""
    both = means(short, "joint:gamma=1", gamma=7, prune_type=0.1)
    assert both.tobytes() == means(short, "joint:gamma=1,prune_type=0.1").tobytes()
    assert both.tobytes() != means(short, "joint", gamma=7, prune_type=0.1).tobytes()


def test_dead_reckoning_is_the_nominal_motion(short: Scenario) -> None:
    state = np.array(short.initial_state)
    for mean in means(short, "dead_reckoning"):
        np.testing.assert_allclose(mean, state, atol=1e-12)
        state = propagate(state, short.controls[0], short.period)
    spread = [np.trace(e.covariance) for e in estimates(short, "dead_reckoning")]
    assert np.all(np.diff(spread) > 0.0)


def test_the_genie_reports_the_true_landmarks(short: Scenario) -> None:
    last = estimates(short, "genie")[-1].landmarks
    assert len(last.ids) >= 5
    for source, kind, place in zip(last.ids, last.types, last.positions, strict=True):
        assert kind == short.landmark_types[source - 1]
        error = place - short.landmarks[source - 1]
        assert np.linalg.norm(error) < 10.0
        covariance = last.covariances[last.ids == source][0]
        assert error @ np.linalg.solve(covariance, error) < chi2.ppf(0.9999, 3)
    assert np.all(last.type_probabilities[np.arange(len(last.ids)), last.types] == 1.0)
    assert LandmarkType.BS not in last.types


@pytest.mark.parametrize(
    ("label", "settings", "words"),
    [
        ("jiont", {}, ["unknown filter 'jiont'", "did you mean 'joint'"]),
        ("joint:gama=3", {}, ["joint:gama=3", "did you mean 'gamma'"]),
        ("joint:gamma=0", {}, ["joint:gamma=0", "1 .. 1000"]),
        ("joint:gamma", {}, ["NAME=VALUE"]),
        ("joint:", {}, ["NAME=VALUE"]),
        ("joint:coupling=marginal", {}, ["coupling = joint, not marginal", "another filter"]),
        ("marginal", {"coupling": "joint"}, ["coupling = marginal, not joint"]),
        ("joint", {"density": "pmbm"}, ["density = pmb, not pmbm"]),
    ],
)
def test_labels_that_name_no_filter(
    short: Scenario, label: str, settings: dict[str, object], words: list[str]
) -> None:
    with pytest.raises(ParameterError) as caught:
        make_estimator(label, short, settings)
    for word in words:
        assert word in str(caught.value)


def test_a_filter_that_fails_says_so(short: Scenario, monkeypatch: pytest.MonkeyPatch) -> None:
    """The live filter goes on without the step; a study must not count on as if nothing was."""

    def fail(*arguments: object) -> None:
        raise np.linalg.LinAlgError("singular matrix")

    estimator = make_estimator("joint", short, {})
    snapshots = list(simulate(short, np.random.default_rng(3)))
    estimator.step(snapshots[0])
    monkeypatch.setattr("dopslam_ros.core.monitoring.recovery.step", fail)
    with pytest.raises(EstimatorError, match="step 1: numerical_failure"):
        estimator.step(snapshots[1])


# --- the weight of the correct association --------------------------------------------------------


def snapshot(*sources: int) -> Snapshot:
    nothing = MeasurementSet(np.zeros((len(sources), 6)), np.zeros((len(sources), 6, 6)))
    return Snapshot(0, 0, Control(0.0, 0.0), np.zeros(4), nothing, np.array(sources))


def associations(rows: list[list[int]], weight: list[float], born: list[int]) -> Associations:
    none = np.zeros(0)
    return Associations(
        np.array(rows), np.array(weight), np.array(born), 0.0, 0, 0.0, none.astype(int), none, none
    )


def test_the_weight_of_the_correct_association() -> None:
    tracker = SourceTracker()
    none, new = np.zeros(0, dtype=np.int64), NONE
    # BS, landmark 3 for the first time, clutter: right is the BS and twice new.
    first = associations([[0, new, new], [new, new, new]], [0.8, 0.2], [new, 7, 8])
    assert tracker.correct_weight(snapshot(0, 3, CLUTTER), first, none) == pytest.approx(0.8)
    # Landmark 3 is track 7 from now on; landmark 5 is new.
    known = np.array([7, 8])
    second = associations([[7, new], [8, new], [new, new], [7, 8]], [0.4, 0.3, 0.2, 0.1], [9, 10])
    assert tracker.correct_weight(snapshot(3, 5), second, known) == pytest.approx(0.4)
    # Track 10 is landmark 5, and track 7 has got most of landmark 3's paths.
    third = associations([[10, 7], [7, 10]], [0.9, 0.1], [new, new])
    assert tracker.correct_weight(snapshot(5, 3), third, np.array([7, 9, 10])) == pytest.approx(0.9)
    # Track 7 died: track 9, born from a path of landmark 3, stands for it now.
    fourth = associations([[new], [9]], [0.7, 0.3], [11])
    assert tracker.correct_weight(snapshot(3), fourth, np.array([9, 10])) == pytest.approx(0.3)
    # Track 11 was fed more of it since (0.7 against 0.2 + 0.3).
    fifth = associations([[11], [9], [new]], [0.6, 0.3, 0.1], [new])
    known = np.array([9, 10, 11])
    assert tracker.correct_weight(snapshot(3), fifth, known) == pytest.approx(0.6)
    # All that stood for it are gone: it counts as new.
    sixth = associations([[10], [new]], [0.6, 0.4], [12])
    assert tracker.correct_weight(snapshot(3), sixth, np.array([10])) == pytest.approx(0.4)


def test_a_track_stands_for_one_landmark_only() -> None:
    tracker = SourceTracker()
    none, new = np.zeros(0, dtype=np.int64), NONE
    tracker.correct_weight(snapshot(1), associations([[new]], [1.0], [7]), none)
    # Landmark 2 is taken for track 7 as well, less surely.
    mixed = associations([[7], [new]], [0.6, 0.4], [8])
    tracker.correct_weight(snapshot(2), mixed, np.array([7]))
    both = associations([[7, 8], [8, 7]], [0.9, 0.1], [new, new])
    assert tracker.correct_weight(snapshot(1, 2), both, np.array([7, 8])) == pytest.approx(0.9)


def test_several_hypotheses_with_the_right_association_add_up() -> None:
    # The same association twice: split by the type of a landmark.
    twice = associations([[0], [0], [NONE]], [0.5, 0.3, 0.2], [NONE])
    weight = SourceTracker().correct_weight(snapshot(0), twice, np.zeros(0, dtype=np.int64))
    assert weight == pytest.approx(0.8)


def test_none_right_is_zero() -> None:
    wrong = associations([[NONE]], [1.0], [4])
    weight = SourceTracker().correct_weight(snapshot(0), wrong, np.zeros(0, dtype=np.int64))
    assert weight == 0.0
