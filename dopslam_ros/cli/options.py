"""Options that several commands have, and what their values mean."""

from __future__ import annotations

import argparse
import difflib
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from dopslam_ros.core.settings.parameters import ParameterError, checked_values, parse_assignment
from dopslam_ros.simulation.scenes import builtin_scenarios
from dopslam_ros.system.errors import UsageError
from dopslam_ros.system.files import json_text


def add_scenario(parser: argparse.ArgumentParser, default: str) -> None:
    """``--scenario``."""
    scenario = parser.add_argument(
        "--scenario",
        default=default,
        help=f"a YAML file, or one of {', '.join(builtin_scenarios())} (default: {default})",
    )
    # What a shell completes it to.
    vars(scenario)["completer"] = lambda **_: builtin_scenarios()


def add_seed(parser: argparse.ArgumentParser) -> None:
    """``--seed`` of one run."""
    parser.add_argument("--seed", type=whole_from_zero, help="of the run (default: the scenario's)")


def add_runs(parser: argparse.ArgumentParser, default: int) -> None:
    """``--runs``, and ``--seed`` of all of them."""
    parser.add_argument(
        "--runs", type=whole_from_one, default=default, help=f"of each (default: {default})"
    )
    parser.add_argument("--seed", type=whole_from_zero, default=1, help="of all (default: 1)")


def add_list(parser: argparse.ArgumentParser, title: str, texts: Mapping[str, str]) -> None:
    """Names and what they mean, below the options."""
    lines = [f"  {name:16}{text}" for name, text in texts.items()]
    parser.epilog = "\n".join([f"{title}:", *lines, "", str(parser.epilog)])


def add_settings(parser: argparse.ArgumentParser) -> None:
    """``--params`` and ``--param``."""
    parser.add_argument("--params", type=Path, help="YAML file of filter parameters")
    parser.add_argument(
        "--param", action="append", default=[], metavar="NAME=VALUE", help="one filter parameter"
    )


def add_json(parser: argparse.ArgumentParser) -> None:
    """``--json``."""
    parser.add_argument("--json", type=Path, metavar="F", help="file for the result as JSON")


def add_quiet(parser: argparse.ArgumentParser) -> None:
    """``--quiet``."""
    parser.add_argument("-q", "--quiet", action="store_true", help="say nothing but errors")


def nearest_file(options: Any) -> str:
    """A hint at the file beside one that was to be read and is not there."""
    for name in ("bag", "old", "study", "file", "map"):
        path = getattr(options, name, None)
        if not isinstance(path, Path) or path.exists() or not path.parent.is_dir():
            continue
        near = difflib.get_close_matches(path.name, [p.name for p in path.parent.iterdir()], n=1)
        if near:
            return f"; did you mean '{path.parent / near[0]}'?"
    return ""


def read_settings(options: Any) -> dict[str, Any]:
    """Filter parameters from --params and --param, checked."""
    values: dict[str, Any] = {}
    if options.params is not None:
        try:
            content = yaml.safe_load(options.params.read_text(encoding="utf-8"))
        except yaml.YAMLError as error:
            raise UsageError(f"'{options.params}' is not YAML: {error}") from error
        if isinstance(content, dict) and set(content) == {"/**"}:  # as a ROS parameter file
            content = content["/**"].get("ros__parameters", {})
        if not isinstance(content, dict):
            raise UsageError(f"'{options.params}' must hold 'name: value' lines")
        values |= content
    for item in options.param:
        try:
            name, value = parse_assignment(item)
        except ParameterError as error:
            raise UsageError(f"--param {error}") from error
        values[name] = value
    from dopslam_ros.core.pmb import FilterParameters

    return checked_values(FilterParameters, values)


def check_files(options: Any) -> None:
    """Files that cannot be written are told before the work is done, not after."""
    for option in ("json", "picture", "markdown", "save_map"):
        path: Path | None = getattr(options, option, None)
        if path is not None and (not path.parent.is_dir() or path.is_dir()):
            name = option.replace("_", "-")
            raise UsageError(f"--{name} {path}: give a file in a folder that exists")
        if path is not None and option == "picture" and path.suffix not in (".png", ".svg"):
            raise UsageError(f"--picture {path}: give a name that ends in .png or .svg")


def write_json(path: Path | None, content: dict[str, Any]) -> None:
    """Writes the result, if a file was asked for."""
    if path is not None:
        path.write_text(json_text(content), "utf-8")


def positive_number(text: str) -> float:
    """A number above zero, for argparse."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"'{text}' must be a number above 0")
    return value


def whole_from_one(text: str) -> int:
    """A whole number from 1 on, for argparse."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"'{text}' must be a whole number from 1 on")
    return int(text)


def whole_from_zero(text: str) -> int:
    """A whole number from 0 on, for argparse."""
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"'{text}' must be a whole number from 0 on")
    return int(text)
