"""Parameters: what a declaration lets through, what the errors say, and the YAML that comes out."""

from __future__ import annotations

import array
import dataclasses
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import yaml

from dopslam_ros.core.pmb import FilterParameters
from dopslam_ros.core.settings.bounding import BoundsParameters
from dopslam_ros.core.settings.layout import VEHICLE, listed
from dopslam_ros.core.settings.model import ModelParameters, OnlineParameters
from dopslam_ros.core.settings.parameters import (
    ParameterError,
    commented_yaml,
    declarations,
    from_mapping,
    parameter,
    shared_values,
    to_mapping,
    unknown_name,
)
from dopslam_ros.simulation.scenario import Scenario, load_scenario

CLASSES = [ModelParameters, OnlineParameters, FilterParameters, BoundsParameters]


@dataclass(frozen=True)
class Sample:
    """One parameter of each kind."""

    flag: bool = parameter(False, "A switch.")
    count: int = parameter(3, "A number of things.", low=1, high=9)
    length: float = parameter(1.5, "A length.", unit="m", low=0.0)
    mode: str = parameter("slow", "A choice.", choices=("slow", "fast"))
    title: str = parameter("", "Any text.")
    stds: tuple[float, ...] = parameter((0.1, 0.2), "Two.", unit="rad", size=2, low=0.0, nan=True)
    interval: tuple[float, ...] = parameter((0.0, 1.0), "From, to.", size=2, increasing=True)
    names: tuple[str, ...] = parameter(("a",), "Some names.")


@pytest.mark.parametrize("kind", [*CLASSES, Sample])
@pytest.mark.parametrize("ros", [False, True])
def test_defaults_round_trip_through_the_commented_yaml(kind: type[Any], ros: bool) -> None:
    text = commented_yaml(kind(), ros=ros)
    content = yaml.safe_load(text)
    values = content["/**"]["ros__parameters"] if ros else content
    assert list(values) == [d.name for d in declarations(kind)]
    assert from_mapping(kind, values) == kind()
    # A comment stands before every parameter.
    lines = [line.strip() for line in text.splitlines()]
    for declared in declarations(kind):
        place = next(i for i, line in enumerate(lines) if line.startswith(f"{declared.name}:"))
        assert lines[place - 1].startswith("# ") and declared.text in lines[place - 1]
        if declared.unit:
            assert f"[{declared.unit}]" in lines[place - 1]


def test_values_with_nan_and_small_numbers_round_trip() -> None:
    settings = FilterParameters(
        measurement_noise_std=(0.1, 1e-9, math.nan, 1e-5, math.nan, 1e22),
        undetected_intensity=1e-15,
        gate_probability=1.0 - 1e-12,
        initial_state=(-0.0, 1e-300, -math.pi, 1e16),
    )
    again = from_mapping(FilterParameters, yaml.safe_load(commented_yaml(settings)))
    for name, value in to_mapping(settings).items():
        np.testing.assert_array_equal(getattr(again, name), value, err_msg=name)


def test_a_scenario_round_trips_too() -> None:
    scenario = load_scenario("paper")
    again = from_mapping(Scenario, yaml.safe_load(commented_yaml(scenario)))
    assert to_mapping(again) == to_mapping(scenario)


@pytest.mark.parametrize("kind", CLASSES)
def test_every_declaration_holds_its_own_default(kind: type[Any]) -> None:
    for declared in declarations(kind):
        assert declared.check(declared.default) == declared.default, declared.name
        assert declared.text.strip().endswith("."), declared.name
        assert type(declared.check(declared.default)) is type(declared.default)


@pytest.mark.parametrize(
    ("name", "value", "remedy"),
    [
        ("flag", 1, "true or false"),
        ("flag", "yes", "true or false"),
        ("count", 0, "1 .. 9"),
        ("count", 10, "1 .. 9"),
        ("count", 2.5, "whole number"),
        ("count", True, "number"),
        ("count", "3", "number"),
        ("length", -0.1, "0 .. inf"),
        ("length", math.nan, "NaN"),
        ("length", math.inf, "finite"),
        ("length", None, "number"),
        ("length", [1.0], "number"),
        ("mode", "fst", "slow, fast"),
        ("mode", 3, "text"),
        ("stds", [0.1], "2 numbers, not 1"),
        ("stds", [0.1, -0.2], "0 .. inf"),
        ("stds", [0.1, math.inf], "finite"),
        ("stds", "ab", "list"),
        ("stds", 0.1, "list"),
        ("stds", {"a": 1}, "list"),
        ("interval", [1.0, 1.0], "smaller number first"),
        ("interval", [1.0, math.nan], "NaN"),
        ("names", [1], "text"),
    ],
)
def test_errors_name_name_value_and_remedy(name: str, value: object, remedy: str) -> None:
    with pytest.raises(ParameterError) as caught:
        from_mapping(Sample, {name: value})
    text = str(caught.value)
    assert f"'{name}'" in text and remedy in text
    inner = value[-1] if isinstance(value, list) and "not" not in remedy else value
    assert repr(inner) in text or repr(value) in text
    unit = {d.name: d.unit for d in declarations(Sample)}[name]
    assert f"[{unit}]" in text if unit else "[]" not in text.split("=", maxsplit=1)[0]


def test_values_are_converted_to_the_declared_type() -> None:
    sample = from_mapping(Sample, {"length": 2, "stds": [1, math.nan], "names": []})
    assert type(sample.length) is float and sample.length == 2.0
    assert type(sample.stds) is tuple and type(sample.stds[0]) is float
    assert math.isnan(sample.stds[1])
    assert sample.names == ()
    for given in (np.array([0.5, 0.6]), array.array("d", [0.5, 0.6]), (0.5, 0.6)):
        assert from_mapping(Sample, {"stds": given}).stds == (0.5, 0.6)


def test_unknown_names_suggest_the_nearest() -> None:
    with pytest.raises(ParameterError, match="unknown parameter 'lenght': did you mean 'length'"):
        from_mapping(Sample, {"lenght": 1.0})
    with pytest.raises(ParameterError, match="known: flag, count"):
        from_mapping(Sample, {"zzzzzz": 1.0})
    with pytest.raises(ParameterError, match="did you mean 'measurement_noise_std'"):
        from_mapping(FilterParameters, {"measurement_noise": 1.0})
    assert unknown_name("thing", "b", ["a"]) == "unknown thing 'b': known: a"


def test_every_value_is_checked_and_converted() -> None:
    with pytest.raises(ParameterError, match="'count' = 77"):
        from_mapping(Sample, {"count": 77})
    assert from_mapping(Sample, {"stds": [1, 2]}).stds == (1.0, 2.0)


def test_vehicle_parameters_have_a_number_for_each_component() -> None:
    declared = {d.name: d for d in declarations(ModelParameters)}
    for name in ("initial_state", "initial_std", "process_noise_std"):
        assert declared[name].size == len(VEHICLE)
        assert declared[name].unit == "m, m, rad, m"
    text = "x, y [m], heading [rad], clock bias [m]"
    assert text == listed(VEHICLE) and text in declared["initial_state"].text


def test_shared_values_are_those_that_both_declare() -> None:
    scenario = dataclasses.replace(load_scenario("paper"), clutter_mean=7.0)
    shared = shared_values(scenario, FilterParameters)
    assert shared["clutter_mean"] == 7.0
    assert "seed" not in shared and "landmarks" not in shared and "gamma" not in shared
    assert shared_values(Sample(), FilterParameters) == {}


def test_ranges_in_words() -> None:
    words = {d.name: d.range_text() for d in declarations(Sample)}
    assert words["count"] == "1 .. 9" and words["length"] == "0 .. inf"
    assert words["mode"] == "one of slow, fast" and words["title"] == "any"
