"""Parameters declared once: name, default, unit, range and text in one dataclass field.

A node's ROS parameters, its YAML file and the options of the command line all derive from these
declarations, so that none of them can disagree with another.
"""

from __future__ import annotations

import contextlib
import dataclasses
import difflib
import itertools
import math
import re
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar, cast

import yaml

Value = bool | int | float | str | tuple[float, ...] | tuple[str, ...]
P = TypeVar("P")


class ParameterError(ValueError):
    """A parameter has an unknown name or a value that cannot be used."""


@dataclasses.dataclass(frozen=True)
class Declaration:
    """What is known about one parameter besides its value.

    Attributes:
        name: as in YAML and on the command line.
        default: also tells the type: bool, int, float, str, or a tuple of floats or strings.
        text: one sentence.
        unit: SI unit, or "" for a pure number.
        low: smallest value allowed (of each element), or None.
        high: largest value allowed (of each element), or None.
        choices: the strings allowed, or () for any.
        size: number of elements of a tuple, or None for any.
        nan: whether an element may be NaN.
        increasing: whether a tuple must be strictly increasing, as an interval is.
        dynamic: whether it may change while a node runs.
    """

    name: str
    default: Value
    text: str
    unit: str
    low: float | None
    high: float | None
    choices: tuple[str, ...]
    size: int | None
    nan: bool
    increasing: bool
    dynamic: bool

    def check(self, value: object) -> Value:
        """The value, converted to the declared type.

        Raises:
            ParameterError: wrong type, outside the range; the message says which and what to do.
        """
        if isinstance(self.default, tuple):
            return self._check_tuple(value)
        scalar: Value = self._check_scalar(value)
        return scalar

    def range_text(self) -> str:
        """The values allowed, in words."""
        if self.choices:
            return "one of " + ", ".join(self.choices)
        if self.low is None and self.high is None:
            return "any"
        low = "-inf" if self.low is None else f"{self.low:g}"
        high = "inf" if self.high is None else f"{self.high:g}"
        return f"{low} .. {high}"

    def _check_tuple(self, value: object) -> Value:
        if isinstance(value, str) or not isinstance(value, Sequence):
            # NumPy and array.array values come from ROS.
            tolist = getattr(value, "tolist", None)
            if tolist is None:
                raise self._error(value, "give a list")
            value = tolist()
        assert isinstance(value, Sequence)
        items = tuple(self._check_scalar(item) for item in value)
        if self.size is not None and len(items) != self.size:
            raise self._error(value, f"give {self.size} numbers, not {len(items)}")
        if self.increasing and any(not b > a for a, b in itertools.pairwise(items)):
            raise self._error(value, "give the smaller number first")
        return items

    def _check_scalar(self, value: object) -> Any:
        sample = self.default
        if isinstance(sample, tuple):
            sample = sample[0] if sample else ""
        if isinstance(sample, bool):
            if not isinstance(value, bool):
                raise self._error(value, "give true or false")
            return value
        if isinstance(sample, str):
            if not isinstance(value, str):
                raise self._error(value, "give a text")
            if self.choices and value not in self.choices:
                raise self._error(value, f"give {self.range_text()}")
            return value
        return self._check_number(value, whole=isinstance(sample, int))

    def _check_number(self, value: object, *, whole: bool) -> int | float:
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise self._error(value, "give a number")
        if whole and not isinstance(value, int):
            raise self._error(value, "give a whole number")
        number = float(value)
        if math.isnan(number):
            if self.nan:
                return number
            raise self._error(value, "NaN means nothing here: give a number")
        if math.isinf(number):
            raise self._error(value, "give a finite number")
        if (self.low is not None and number < self.low) or (
            self.high is not None and number > self.high
        ):
            raise self._error(value, f"give a value in {self.range_text()}")
        return value if whole else number

    def _error(self, value: object, remedy: str) -> ParameterError:
        unit = f" [{self.unit}]" if self.unit else ""
        return ParameterError(f"parameter '{self.name}'{unit} = {value!r}: {remedy}")


def parameter(
    default: Value,
    text: str,
    *,
    unit: str = "",
    low: float | None = None,
    high: float | None = None,
    choices: tuple[str, ...] = (),
    size: int | None = None,
    nan: bool = False,
    increasing: bool = False,
    dynamic: bool = False,
) -> Any:
    """Declares a field of a parameter dataclass; see Declaration for the arguments."""
    details = {
        "text": text,
        "unit": unit,
        "low": low,
        "high": high,
        "choices": choices,
        "size": size,
        "nan": nan,
        "increasing": increasing,
        "dynamic": dynamic,
    }
    return dataclasses.field(default=default, metadata={"parameter": details})


def declarations(parameters: type[Any]) -> tuple[Declaration, ...]:
    """The declarations of a parameter dataclass, in the order they are written."""
    return tuple(
        Declaration(field.name, cast(Value, field.default), **field.metadata["parameter"])
        for field in dataclasses.fields(parameters)
        if "parameter" in field.metadata
    )


def parse_assignment(text: str) -> tuple[str, object]:
    """The name and the value of ``NAME=VALUE``, the value as YAML has it.

    Raises:
        ParameterError: not of this form, or the value is no YAML.
    """
    name, equals, value = text.partition("=")
    if not equals:
        raise ParameterError(f"{text}: write NAME=VALUE")
    try:
        parsed = yaml.safe_load(value)
    except yaml.YAMLError as error:
        raise ParameterError(f"{text}: the value is not YAML: {error}") from error
    if isinstance(parsed, str):  # YAML takes 1e-3 for a text
        with contextlib.suppress(ValueError):
            return name.strip(), float(parsed)
    return name.strip(), parsed


def parse_assignments(text: str) -> dict[str, object]:
    """Names and values of ``NAME=VALUE,NAME=VALUE``; lists may have commas of their own.

    Raises:
        ParameterError: not of this form, or a value is no YAML.
    """
    # Only a comma before the next name separates.
    return dict(map(parse_assignment, re.split(r",(?=\s*\w+\s*=)", text)))


def checked_values(parameters: type[Any], mapping: Mapping[str, object]) -> dict[str, Value]:
    """Names and values for a parameter dataclass, each checked and converted.

    Raises:
        ParameterError: an unknown name (the nearest valid one is suggested) or a bad value.
    """
    known = {d.name: d for d in declarations(parameters)}
    for name in mapping:
        if name not in known:
            raise ParameterError(unknown_name("parameter", name, known))
    return {name: known[name].check(value) for name, value in mapping.items()}


def from_mapping(parameters: type[P], mapping: Mapping[str, object], **extra: object) -> P:
    """Parameters from names and values; what is not named keeps its default.

    Args:
        parameters: the dataclass.
        mapping: names to values.
        extra: fields that are not declared parameters.

    Raises:
        ParameterError: an unknown name (the nearest valid one is suggested) or a bad value.
    """
    return parameters(**checked_values(parameters, mapping), **extra)


def unknown_name(kind: str, name: str, known: Mapping[str, object] | Sequence[str]) -> str:
    """A sentence about a name that does not exist, with the nearest one that does."""
    near = difflib.get_close_matches(str(name), list(known), n=1)
    hint = f"did you mean '{near[0]}'?" if near else "known: " + ", ".join(known)
    return f"unknown {kind} '{name}': {hint}"


def to_mapping(instance: object) -> dict[str, Any]:
    """Names and values, tuples as lists: ready for YAML or JSON."""
    values = {d.name: getattr(instance, d.name) for d in declarations(type(instance))}
    return {name: list(v) if isinstance(v, tuple) else v for name, v in values.items()}


def shared_values(source: object, target: type[Any]) -> dict[str, Any]:
    """The values of ``source`` for those parameters that ``target`` declares too."""
    wanted = {d.name for d in declarations(target)}
    return {d.name: getattr(source, d.name) for d in declarations(type(source)) if d.name in wanted}


def commented_yaml(instance: object, *, ros: bool = False) -> str:
    """A YAML text with a comment per parameter.

    Args:
        instance: the values to write.
        ros: as a ROS parameter file (``/**: ros__parameters:``) instead of plain names.
    """
    indent = "    " if ros else ""
    lines = ["/**:", "  ros__parameters:"] if ros else []
    for declared in declarations(type(instance)):
        value = getattr(instance, declared.name)
        value = list(value) if isinstance(value, tuple) else value
        unit = f" [{declared.unit}]" if declared.unit else ""
        allowed = declared.range_text()
        comment = f"{declared.text}{unit}" + (f" ({allowed})" if allowed != "any" else "")
        text = yaml.safe_dump(value, default_flow_style=True, width=1000).removesuffix("...\n")
        lines += [f"{indent}# {comment}", f"{indent}{declared.name}: {text.strip()}"]
    return "\n".join(lines) + "\n"
