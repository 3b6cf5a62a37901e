"""Parameters: what cannot be used is refused, with the reason and what to do."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
import yaml

from dopslam_ros.core.settings.parameters import declarations, to_mapping
from dopslam_ros.nodes.bounds import BoundsNode, BoundsNodeParameters
from dopslam_ros.nodes.errors import StartError
from dopslam_ros.nodes.filter import FilterNode
from dopslam_ros.nodes.filter_parameters import FilterNodeParameters
from dopslam_ros.nodes.player import PlayerNode, PlayerParameters
from dopslam_ros.nodes.recorder import RecorderNode, RecorderParameters
from dopslam_ros.nodes.simulator import SimulatorNode, SimulatorParameters

if TYPE_CHECKING:
    from tests.conftest import Processes, Ros


@pytest.mark.parametrize(
    ("node", "arguments", "words"),
    [
        ("filter", ["-p", "gamma:=0"], ("'gamma'", "= 0", "1 .. 1000")),
        ("filter", ["-p", "gamma:=ten"], ("'gamma'", "'ten'", "number")),
        ("filter", ["-p", "detection_probability:=1.5"], ("'detection_probability'", "1.5", "1")),
        ("filter", ["-p", "detection_probability:=1"], ("'detection_probability'", "= 1", "1.0")),
        ("filter", ["-p", "coupling:=foo"], ("'coupling'", "'foo'", "joint, marginal")),
        ("simulator", ["-p", "scenario:=papper"], ("papper", "did you mean 'paper'")),
        ("filter", ["-p", "bs_position:=[0,0,40]"], ("'bs_position'", "[0.0, 0.0, 40.0]")),
        ("filter", ["--params-file", "nix.yaml"], ("nix.yaml",)),
        ("filter", ["-r", "__ns:=car1/"], ("car1/",)),
        ("recorder", ["-p", "extra_topics:='bad name'"], ("bad name",)),
        ("player", [], ("'bag'", "empty", "-p bag:=")),
        ("player", ["-p", "bag:=/nowhere/at/all"], ("/nowhere/at/all", "no bag", "give")),
    ],
    ids=lambda value: "_".join(value) if isinstance(value, list) else None,
)
def test_refused_at_start(
    processes: Processes, node: str, arguments: list[str], words: tuple[str, ...]
) -> None:
    """A bad value at start: one sentence with name, value and remedy, exit code 2, no traceback."""
    process = processes.node(node, *arguments)
    assert process.wait() == 2
    assert "Traceback" not in process.stderr
    (line,) = [line for line in process.stderr.splitlines() if line.startswith("error: ")]
    for word in words:
        assert word in line, line


def test_a_file_of_parameters_is_taken(processes: Processes, tmp_path: Path) -> None:
    """A YAML file keyed /** is applied and logged; an unknown name in it is warned of."""
    file = tmp_path / "filter.yaml"
    content = {"/**": {"ros__parameters": {"gamma": 3, "coupling": "marginal", "gama": 4}}}
    file.write_text(yaml.safe_dump(content), "utf-8")
    process = processes.node("filter", "--params-file", str(file))
    process.wait_for("ready")
    assert process.stop() == 0
    log = process.stderr
    assert "gamma: 3" in log and "coupling: marginal" in log
    (warning,) = [line for line in log.splitlines() if "WARN" in line]
    assert "'gama'" in warning and "unknown" in warning


def test_resolved_values_are_logged(processes: Processes) -> None:
    """Every parameter of a node is in its log with the value it has."""
    process = processes.node("filter")
    process.wait_for("ready")
    assert process.stop() == 0
    for name, value in to_mapping(FilterNodeParameters()).items():
        assert re.search(rf"\[filter\]: {name}: {re.escape(str(value))}$", process.stderr, re.M)


Kind = tuple[Callable[..., Any], type[Any], dict[str, object]]
NODES: tuple[Kind, ...] = (
    (SimulatorNode, SimulatorParameters, {}),
    (FilterNode, FilterNodeParameters, {}),
    (BoundsNode, BoundsNodeParameters, {}),
    (RecorderNode, RecorderParameters, {"bag": "{tmp}/bag"}),
    (PlayerNode, PlayerParameters, {"bag": "{simulated}"}),
)


@pytest.mark.parametrize("kind", NODES, ids=lambda kind: kind[0].__name__)
def test_every_parameter_is_declared_with_its_text(
    ros: Ros, tmp_path: Path, simulated: Path, kind: Kind
) -> None:
    """A node declares what its dataclass does: text, unit, allowed values, read-only or not."""
    create, parameters, given = kind
    places = {"tmp": str(tmp_path), "simulated": str(simulated)}
    values = {name: str(value).format(**places) for name, value in given.items()}
    node = ros.start(create, **values)
    for declared in declarations(parameters):
        descriptor = node.describe_parameter(declared.name)
        assert descriptor.description.startswith(declared.text)
        assert declared.unit in descriptor.description
        assert descriptor.read_only is not declared.dynamic
        assert descriptor.additional_constraints == declared.range_text()
        default = values.get(declared.name, declared.default)
        value = node.get_parameter(declared.name).value
        value = tuple(value) if isinstance(default, tuple) else value
        assert repr(value) == repr(default)


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (0.0, ("rate",)),
        (-3.0, ("rate",)),
        (float("nan"), ("rate",)),
        (float("inf"), ("rate",)),
        ("fast", ("DOUBLE", "STRING")),
        (True, ("DOUBLE", "BOOL")),
    ],
)
def test_refused_at_run_time(ros: Ros, scene: Path, value: object, words: tuple[str, ...]) -> None:
    """A dynamic parameter refuses what it cannot use, says why, and keeps its value."""
    from rclpy.parameter import Parameter

    node = ros.start(SimulatorNode, scenario=str(scene), wait_for_nodes="nobody", rate=2.0)
    (result,) = node.set_parameters([Parameter("rate", value=value)])
    assert not result.successful
    assert all(word in result.reason for word in words), result.reason
    assert node.get_parameter("rate").value == 2.0
    (result,) = node.set_parameters([Parameter("rate", value=5.0)])
    assert result.successful and node.get_parameter("rate").value == 5.0


@pytest.mark.parametrize(("name", "value"), [("gamma", 5), ("coupling", "marginal")])
def test_a_read_only_parameter_stays(ros: Ros, name: str, value: object) -> None:
    """What cannot change while the filter runs is refused, with a reason."""
    from rclpy.parameter import Parameter

    node = ros.start(FilterNode)
    before = node.get_parameter(name).value
    (result,) = node.set_parameters([Parameter(name, value=value)])
    assert not result.successful
    assert "read-only" in result.reason
    assert node.get_parameter(name).value == before


def test_refused_through_the_service(ros: Ros, scene: Path) -> None:
    """From outside, as `ros2 param set` does it: refused with the reason in the answer."""
    from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
    from rcl_interfaces.srv import SetParameters

    node = ros.start(SimulatorNode, scenario=str(scene), wait_for_nodes="nobody")
    client = ros.node("somebody").create_client(SetParameters, "/simulator/set_parameters")
    ros.spin_until(client.service_is_ready)
    value = ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=1e9)
    request = SetParameters.Request(parameters=[Parameter(name="rate", value=value)])
    future = client.call_async(request)
    ros.spin_until(future.done)
    (result,) = future.result().results
    assert not result.successful and "rate" in result.reason
    assert node.get_parameter("rate").value == 1.0


@pytest.mark.parametrize(
    ("create", "name", "value", "sentence"),
    [
        (FilterNode, "gamma", 0, "parameter 'gamma' = 0: give a value in 1 .. 1000"),
        (FilterNode, "bs_position", [1.0, 2.0], "'bs_position' [m] = [1.0, 2.0]: give 3 numbers"),
        (FilterNode, "clutter_doppler", [5.0, -5.0], "[5.0, -5.0]: give the smaller number first"),
        (FilterNode, "initial_std", [0.0, 1.0, 1.0, 1.0], "= 0.0: give a value in 1e-09 .. inf"),
        (FilterNode, "control_wait", float("nan"), "'control_wait' [s] = nan"),
        (BoundsNode, "source", "moon", "'moon': give one of auto, truth, estimate"),
        (SimulatorNode, "rate", -1.0, "'rate' = -1.0: give a value in 0.001 .. 1e+06"),
    ],
)
def test_a_bad_value_in_process(
    ros: Ros, create: Callable[..., Any], name: str, value: object, sentence: str
) -> None:
    """The same refusal as an exception where a node is made in a program."""
    with pytest.raises(StartError, match=re.escape(sentence)):
        ros.start(create, **{name: value})


def test_an_unknown_name_is_warned_of(ros: Ros, capfd: pytest.CaptureFixture[str]) -> None:
    """A misspelt parameter is not ignored silently; nothing else is complained of."""
    ros.start(FilterNode, gama=3, use_sim_time=False)
    log = capfd.readouterr().err
    assert "parameter 'gama' is given but unknown to this node, and ignored" in log
    assert log.count("WARN") == 1
