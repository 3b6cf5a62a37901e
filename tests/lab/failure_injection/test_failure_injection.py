"""A vehicle that gets lost is found again: how often, how soon and how well."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from dopslam_ros.cli.main import main
from dopslam_ros.lab.failure_injection.kinds import FAILURES
from dopslam_ros.lab.failure_injection.summary import summarise_trials
from dopslam_ros.lab.failure_injection.trial import trial
from dopslam_ros.simulation.scenario import load_scenario

SCENARIO = load_scenario("paper")
RUNS = 12


@pytest.mark.parametrize("kind", FAILURES)
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


def test_the_same_seed_gives_the_same_numbers_by_either_name(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The old name of the command is an alias that says which is the new one."""
    texts = []
    for name in ("inject", "trouble"):
        file = tmp_path / f"{name}.json"
        arguments = ["--kinds", "kidnap", "--runs", "2", "--seed", "3", "--json", str(file)]
        assert main([name, *arguments]) == 0
        kept = json.loads(file.read_text("utf-8"))["kinds"]["kidnap"]
        del kept["lost_ms_max"]
        texts.append(json.dumps(kept))
        said = capsys.readouterr().err
        assert ("'trouble' is called 'inject' now" in said) == (name == "trouble")
    assert texts[0] == texts[1]
    with pytest.raises(SystemExit):
        main(["--help"])
    assert "old name until the next release: trouble" in " ".join(capsys.readouterr().out.split())
