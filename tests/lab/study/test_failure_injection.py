"""A vehicle that gets lost is found again: how often, how soon and how well."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from dopslam_ros.cli.failure_injection import summarise_trials
from dopslam_ros.cli.main import main
from dopslam_ros.lab.study.failure_injection import trial
from dopslam_ros.simulation.scenario import load_scenario

SCENARIO = load_scenario("paper")
RUNS = 12


@pytest.mark.parametrize("kind", ["blackout", "dark", "kidnap", "no_prior", "no_map", "none"])
def test_it_is_found_within_ten_sets_and_the_covariance_is_honest(kind: str) -> None:
    trials = [trial(kind, SCENARIO, np.random.default_rng([5, n])) for n in range(RUNS)]
    found = summarise_trials(trials)
    assert found["recovered_in_time"] >= (RUNS - 1) / RUNS
    # 12 runs of some 18 sets, but errors of a run hang together.
    assert 2.0 < found["nees_mean"] < 8.0
    assert found["position_rmse"] < (3.0 if kind == "no_map" else 1.5)
    if kind == "kidnap":
        assert found["noticed"] >= (RUNS - 1) / RUNS
    if kind == "none":
        assert found["noticed"] == 0.0


def test_the_same_seed_gives_the_same_numbers(tmp_path: Path) -> None:
    texts = []
    for name in ("one.json", "two.json"):
        file = tmp_path / name
        arguments = ["--kinds", "kidnap", "--runs", "2", "--seed", "3", "--json", str(file)]
        assert main(["trouble", *arguments]) == 0
        kept = json.loads(file.read_text("utf-8"))["kinds"]["kidnap"]
        del kept["lost_ms_max"]
        texts.append(json.dumps(kept))
    assert texts[0] == texts[1]
