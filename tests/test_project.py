"""The project holds together: checks, config, reference run, numbers in the README, colcon."""

from __future__ import annotations

import math
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
import yaml
from rosbags.highlevel import AnyReader

import dopslam_ros
from dopslam_ros.bag import BagReader, deserialize
from dopslam_ros.cli.main import main
from dopslam_ros.core.settings.model import with_doppler_std
from dopslam_ros.messages import topics
from dopslam_ros.offline.replay import replay
from dopslam_ros.simulation.matched import nominal_bounds
from dopslam_ros.simulation.scenario import load_scenario

ROOT = Path(__file__).resolve().parents[1]
NODES = ("simulator", "filter", "bounds", "recorder", "player")


def _run(*command: str, **options: Any) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, **options)


@pytest.mark.parametrize("check", [("ruff", "check", "."), ("mypy",)], ids=["style", "types"])
def test_checks_pass(check: tuple[str, ...]) -> None:
    """What `make lint` runs."""
    done = _run(sys.executable, "-m", *check)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize("node", NODES)
def test_config_files_are_the_declarations(node: str, capsys: pytest.CaptureFixture[str]) -> None:
    """config/NODE.yaml is what `dopslam parameters NODE` prints."""
    assert main(["parameters", node]) == 0
    printed = capsys.readouterr().out
    assert (ROOT / "config" / f"{node}.yaml").read_text() == printed
    assert set(yaml.safe_load(printed)) == {"/**"}


def test_versions_agree() -> None:
    """Both package.xml, setup.py and the module say the same version."""
    setup = re.search(r'version="([^"]+)"', (ROOT / "setup.py").read_text())
    assert setup is not None
    manifests = [
        ElementTree.parse(ROOT / folder / "package.xml").getroot() for folder in (".", "msg_defs")
    ]
    versions = {m.findtext("version") for m in manifests}
    assert versions == {setup.group(1)} == {dopslam_ros.__version__}
    assert {m.get("format") for m in manifests} == {"3"}


def test_reference_run_gives_its_states_again() -> None:
    """bags/paper replayed on this machine is what was stored, up to rounding."""
    reader = BagReader(ROOT / "bags" / "paper")
    assert reader.damage is None
    stored = [
        deserialize(message.payload, message.type_name)
        for message in reader.messages({"/" + topics.UE_STATE.name})
    ]
    run = replay(reader)
    assert len(run.outputs) == len(stored) == 40
    for output, state in zip(run.outputs, stored, strict=True):
        x, y, heading, bias = output.state.ue_mean
        np.testing.assert_allclose(
            [x, y, heading, bias],
            [state.x, state.y, state.heading, state.clock_bias],  # type: ignore[attr-defined]
            atol=1e-6,
        )


def test_reference_run_opens_elsewhere() -> None:
    """Another reader finds every topic of the package but the diagnostics in bags/paper."""
    with AnyReader([ROOT / "bags" / "paper"]) as bag:
        found = {c.topic: c.msgtype for c in bag.connections}
    expected = {"/" + t.name: t.type_name for t in topics.RECORDED if t != topics.DIAGNOSTICS}
    assert found == expected


def test_bounds_in_the_readme() -> None:
    """Every number of ours in the README's table of bounds is what the code computes."""
    readme = (ROOT / "README.md").read_text()
    rows = re.findall(r"^\| (without|[\d.]+ m/s) \| (.+) \|$", readme, re.M)
    assert len(rows) == 4
    scenario = load_scenario("paper_bounds")
    for name, cells in rows:
        sigma = None if name == "without" else float(name.removesuffix(" m/s"))
        bound = nominal_bounds(with_doppler_std(scenario, sigma))
        ours = (bound.peb, math.degrees(bound.heb), bound.ceb, float(np.mean(bound.leb)))
        written = [float(cell.split()[0]) for cell in cells.split("|")]
        np.testing.assert_allclose(written, ours, atol=0.00051)


def test_colcon_builds_both_packages(tmp_path: Path) -> None:
    """`colcon build` makes what `ros2 run dopslam_ros NODE` looks for, and the nodes start."""
    tracked = _run("git", "ls-files", "-co", "--exclude-standard").stdout.split("\n")
    for name in filter(None, tracked):
        if (ROOT / name).is_file():
            (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, tmp_path / name)
    environment = f". {shlex.quote(sys.prefix)}/ros_env.sh"
    built = _shell(f"{environment} && colcon build", tmp_path)
    assert built.returncode == 0, built.stdout + built.stderr
    prefix = tmp_path / "install" / "dopslam_ros"
    for node in NODES:
        assert os.access(prefix / "lib" / "dopslam_ros" / node, os.X_OK)
    marker = "share/ament_index/resource_index/packages/dopslam_ros"
    assert (prefix / marker).is_file()
    assert (prefix / "share/dopslam_ros/config/filter.yaml").is_file()
    started = _shell(
        f"{environment} && . install/local_setup.sh"
        " && exec install/dopslam_ros/lib/dopslam_ros/player --ros-args -p bag:=none",
        tmp_path,
    )
    # It ran far enough to look for the bag.
    assert started.returncode == 2
    assert "none" in started.stderr


def _shell(command: str, folder: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ["sh", "-c", command], cwd=folder, capture_output=True, text=True, check=False
    )
