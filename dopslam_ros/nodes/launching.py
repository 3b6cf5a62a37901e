"""What ``launch/dopslam.launch.py`` starts: which nodes, each with which parameters.

Free of ``launch``, which comes with an installed ROS 2 and not with the wheels.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from dopslam_ros.core.settings.parameters import to_mapping, unknown_name
from dopslam_ros.simulation.matched import bounds_parameters_for, filter_parameters_for
from dopslam_ros.simulation.scenario import load_scenario

INPUTS = ("simulator", "bag", "none")


class LaunchError(ValueError):
    """An argument of the launch file cannot be used; the message says why and what to do."""


class Argument(NamedTuple):
    """An argument of the launch file."""

    name: str
    default: str
    text: str
    choices: tuple[str, ...] = ()


TRUTH_VALUES = ("true", "false")
ARGUMENTS = (
    Argument("namespace", "", "Namespace of all nodes: one for each vehicle."),
    Argument(
        "input",
        "simulator",
        "Where sets and controls come from: a simulated scene, a played bag, or other nodes.",
        INPUTS,
    ),
    Argument(
        "scenario",
        "",
        "Scene (a name or a YAML file) for the simulator, whose models set filter and bounds;"
        " empty: the paper's scene, and the nodes' defaults.",
    ),
    Argument("seed", "-1", "Seed of the simulated run; -1: the scenario's."),
    Argument("bag", "", "Bag to play with input:=bag: its folder or an .mcap file."),
    Argument("rate", "1.0", "Times real time, of the simulator and of the bag."),
    Argument(
        "params_file", "", "YAML file of parameters for filter and bounds; it goes before scenario."
    ),
    Argument("bounds", "true", "Whether to compute the error bounds.", TRUTH_VALUES),
    Argument("record", "", "Folder of a new bag to record into; empty: nothing is recorded."),
    Argument("rviz", "false", "Whether to open RViz with config/dopslam.rviz.", TRUTH_VALUES),
    Argument("use_sim_time", "false", "Whether the nodes follow /clock.", TRUTH_VALUES),
    Argument("log_level", "info", "Least severity that the nodes log."),
)


def plan(given: Mapping[str, str]) -> dict[str, dict[str, Any]]:
    """The nodes to start, each with its parameters without those of ``params_file``.

    Args:
        given: arguments by name, as text; what is missing has its default.

    Raises:
        LaunchError: an argument cannot be used.
        ScenarioError: the scenario cannot be read.
    """
    known = {argument.name: argument for argument in ARGUMENTS}
    for name in given:
        if name not in known:
            raise LaunchError(unknown_name("argument", name, known))
    values = {name: argument.default for name, argument in known.items()} | dict(given)
    _check(values, known)
    nodes: dict[str, dict[str, Any]] = {"filter": {}}
    if values["bounds"] == "true":
        nodes["bounds"] = {}
    if values["scenario"]:
        scene = load_scenario(values["scenario"])
        for name, models in (
            ("filter", filter_parameters_for(scene)),
            ("bounds", bounds_parameters_for(scene)),
        ):
            if name in nodes:
                nodes[name] = to_mapping(models)
    listeners = list(nodes)
    if values["record"]:
        for settings in nodes.values():
            settings["wait_for_nodes"] = "recorder"
        nodes["recorder"] = {"bag": values["record"]}
        listeners.append("recorder")
    nodes |= _source(values, ",".join(listeners))
    follows = values["use_sim_time"] == "true"
    # The player makes the time, so it cannot follow it.
    return {
        name: settings | ({"use_sim_time": True} if follows and name != "player" else {})
        for name, settings in nodes.items()
    }


def _source(values: Mapping[str, str], listeners: str) -> dict[str, dict[str, Any]]:
    """The node that the input comes from, if it is one of ours; it waits for its listeners."""
    common = {"rate": _number(values, "rate", float), "wait_for_nodes": listeners}
    if values["input"] == "simulator":
        scene = values["scenario"] or "paper"
        return {
            "simulator": {"scenario": scene, "seed": _number(values, "seed", int), **common},
        }
    if values["input"] == "bag":
        return {"player": {"bag": values["bag"], **common}}
    return {}


def _check(values: Mapping[str, str], known: Mapping[str, Argument]) -> None:
    for name, argument in known.items():
        if argument.choices and values[name] not in argument.choices:
            choices = ", ".join(argument.choices)
            raise LaunchError(f"{name}:={values[name]}: give one of {choices}")
    if (values["input"] == "bag") != bool(values["bag"]):
        raise LaunchError("to play a bag give both input:=bag and bag:=FOLDER; else neither")
    if values["params_file"] and not Path(values["params_file"]).is_file():
        raise LaunchError(f"params_file:={values['params_file']}: there is no such file")


def _number(values: Mapping[str, str], name: str, kind: type[Any]) -> Any:
    try:
        return kind(values[name])
    except ValueError:
        words = "a whole number" if kind is int else "a number"
        raise LaunchError(f"{name}:={values[name]}: give {words}") from None
