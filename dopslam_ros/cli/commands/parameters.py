"""``dopslam parameters``: a parameter file for a node."""

from __future__ import annotations

import argparse
import importlib
from typing import Any

TEXT = "the parameters of a node as a commented YAML file"
EXAMPLE = "dopslam parameters filter > config/filter.yaml"

NODES = {
    node: (f"dopslam_ros.nodes.{node}", name)
    for node, name in (
        ("simulator", "SimulatorParameters"),
        ("filter", "FilterNodeParameters"),
        ("bounds", "BoundsNodeParameters"),
        ("recorder", "RecorderParameters"),
        ("player", "PlayerParameters"),
    )
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of the command."""
    parser.add_argument("node", choices=sorted(NODES), help="which node")
    parser.add_argument(
        "--scenario", help="take what it has of the models: a YAML file or a scene's name"
    )


def run(options: Any) -> int:
    """Prints the file."""
    from dopslam_ros.core.settings.parameters import commented_yaml, shared_values
    from dopslam_ros.simulation.scenario import load_scenario

    module, name = NODES[options.node]
    kind = getattr(importlib.import_module(module), name)
    values, origin = {}, "their defaults"
    if options.scenario is not None:
        scenario = load_scenario(options.scenario)
        values, origin = shared_values(scenario, kind), f"the models of scene '{scenario.name}'"
    print(f"# Parameters of the {options.node} node with {origin}.")
    print(commented_yaml(kind(**values), ros=True), end="")
    return 0
