"""The launch file: which nodes it starts, and that they run together as it says."""

from __future__ import annotations

import ast
import importlib
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
import yaml

from dopslam_ros.bag import BagReader
from dopslam_ros.messages import topics
from dopslam_ros.nodes.launching import ARGUMENTS, LaunchError, plan
from dopslam_ros.simulation.scenario import ScenarioError

if TYPE_CHECKING:
    from tests.conftest import Processes

ROOT = Path(__file__).resolve().parents[2]
LAUNCH_FILE = ROOT / "launch" / "dopslam.launch.py"
STEPS = 8
# Seconds for nodes that compile first, on a busy machine.
COMPILING = 200.0


def test_alone_it_simulates_the_papers_scene() -> None:
    """Filter and bounds keep their own defaults; the simulator waits for both."""
    assert plan({}) == {
        "filter": {},
        "bounds": {},
        "simulator": {
            "scenario": "paper",
            "seed": -1,
            "rate": 1.0,
            "wait_for_nodes": "filter,bounds",
        },
    }


def test_on_a_robot_nothing_is_simulated() -> None:
    """input:=none leaves the nodes that listen."""
    assert set(plan({"input": "none", "record": "b"})) == {"filter", "bounds", "recorder"}
    assert set(plan({"input": "none", "bounds": "false"})) == {"filter"}


def test_a_scene_sets_the_models_of_filter_and_bounds() -> None:
    """As the demo does; whatever the input is."""
    nodes = plan({"scenario": "misdetections", "input": "none"})
    assert nodes["filter"]["detection_probability"] == 0.6
    assert nodes["bounds"]["detection_probability"] == 0.6


def test_the_player_does_not_follow_the_clock_it_makes() -> None:
    """All others do, when told so."""
    nodes = plan({"input": "bag", "bag": "b", "use_sim_time": "true"})
    assert {name for name, settings in nodes.items() if settings.get("use_sim_time")} == {
        "filter",
        "bounds",
    }
    assert nodes["player"]["bag"] == "b"


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"input": "radio"}, "simulator, bag, none"),
        ({"input": "bag"}, "bag:=FOLDER"),
        ({"bag": "b"}, "input:=bag"),
        ({"rate": "fast"}, "rate:=fast: give a number"),
        ({"seed": "1.5"}, "whole number"),
        ({"params_file": "no/such.yaml"}, "no such file"),
        ({"params": "x"}, "did you mean 'params_file'"),
    ],
)
def test_bad_arguments_are_named_with_the_remedy(given: dict[str, str], words: str) -> None:
    """Before anything is started."""
    with pytest.raises(LaunchError, match=words):
        plan(given)


def test_an_unknown_scene_is_told() -> None:
    """By the scenario's own error."""
    with pytest.raises(ScenarioError, match="papers"):
        plan({"scenario": "papers"})


def test_what_is_planned_runs(
    processes: Processes, tmp_path: Path, scene: Path, wait: Callable[..., None]
) -> None:
    """The processes that `ros2 launch` would start record a whole run."""
    bag = tmp_path / "recorded"
    nodes = plan({"scenario": str(scene), "rate": "20.0", "record": str(bag)})
    started = {}
    for name, settings in nodes.items():
        file = tmp_path / f"{name}.yaml"
        file.write_text(yaml.safe_dump({"/**": {"ros__parameters": settings}}), "utf-8")
        started[name] = processes.node(name, "--params-file", str(file))
    wait(lambda: started["simulator"].popen.poll() is not None, COMPILING)
    assert started["simulator"].wait() == 0, started["simulator"].stderr

    def recorded() -> int:
        try:
            found = BagReader(bag).topics
        except Exception:  # hardly begun
            return 0
        return min(
            found[n].message_count if n in found else 0
            for n in ("/" + topics.UE_STATE.name, "/" + topics.BOUNDS.name)
        )

    wait(lambda: recorded() == STEPS)
    assert [started[name].stop() for name in ("filter", "bounds", "recorder")] == [0, 0, 0]


def test_the_file_hands_every_argument_on() -> None:
    """It parses, and reads each argument it uses from those that are declared."""
    tree = ast.parse(LAUNCH_FILE.read_text("utf-8"))
    used = {
        node.slice.value
        for node in ast.walk(tree)
        if isinstance(node, ast.Subscript)
        and isinstance(node.slice, ast.Constant)
        and isinstance(node.slice.value, str)
        and isinstance(node.value, ast.Name)
        and node.value.id == "given"
    }
    assert used and used <= {argument.name for argument in ARGUMENTS}


def test_launch_takes_the_file() -> None:
    """Where ROS 2's launch is installed: the file declares and starts what it should."""
    pytest.importorskip("launch_ros", reason="launch is not among the wheels")
    from launch import LaunchContext
    from launch.actions import DeclareLaunchArgument

    spec: Any = importlib.util.spec_from_file_location("dopslam_launch", LAUNCH_FILE)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    entities = module.generate_launch_description().entities
    declared = [e for e in entities if isinstance(e, DeclareLaunchArgument)]
    assert [e.name for e in declared] == [argument.name for argument in ARGUMENTS]
    context = LaunchContext()
    context.launch_configurations.update({a.name: a.default for a in ARGUMENTS} | {"rviz": "true"})
    started = [node.node_executable for node in module.start(context)]
    assert started == ["filter", "bounds", "simulator", "rviz2"]
    assert module.RVIZ_FILE.is_file()
