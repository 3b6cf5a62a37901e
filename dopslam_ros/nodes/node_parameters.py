"""Declared parameters as a node's: checked at its start and at every change."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.node import Node
from rclpy.parameter import Parameter

from dopslam_ros.core.settings.parameters import (
    Declaration,
    ParameterError,
    declarations,
    from_mapping,
    to_mapping,
)
from dopslam_ros.nodes.errors import StartError

P = TypeVar("P")
# What stands for no bound in a range of whole numbers.
_LARGEST = 2**62


def declared(node: Node, kind: type[P]) -> P:
    """Declares the parameters of a dataclass and returns their resolved values.

    Raises:
        StartError: a value given at start cannot be used.
    """
    values = {one.name: _declare(node, one) for one in declarations(kind)}
    try:
        return from_mapping(kind, values)
    except ParameterError as error:
        raise StartError(str(error)) from error


def unknown(node: Node) -> list[str]:
    """Names that were given and are not declared: misspelt, in a YAML file for instance."""
    return [
        name
        for name in node._parameter_overrides
        if not node.has_parameter(name) and not name.startswith(("qos_overrides.", "use_sim"))
    ]


class Changes:
    """Checks changes of parameters while a node runs.

    Args:
        changed: called with the dataclass of the new values.
    """

    def __init__(self, changed: Callable[[Any], None]) -> None:
        self._changed = changed
        self._sets: list[Any] = []

    def add(self, parameters: Any) -> None:
        """Parameters that may change, with their values now."""
        self._sets.append(parameters)

    def check(self, changes: list[Parameter]) -> SetParametersResult:
        """Whether they can be made; those that can are."""
        new = {change.name: change.value for change in changes}
        for number, current in enumerate(self._sets):
            known = {one.name for one in declarations(type(current))}
            mine = {name: value for name, value in new.items() if name in known}
            if not mine:
                continue
            try:
                changed = from_mapping(type(current), {**to_mapping(current), **mine})
            except ParameterError as error:
                return SetParametersResult(successful=False, reason=str(error))
            self._sets[number] = changed
            self._changed(changed)
        return SetParametersResult(successful=True)


def _declare(node: Node, one: Declaration) -> Any:
    start: Any = list(one.default) if isinstance(one.default, tuple) else one.default
    try:
        return node.declare_parameter(one.name, start, _descriptor(one)).value
    except (InvalidParameterTypeException, InvalidParameterValueException) as error:
        given = node._parameter_overrides.get(one.name)
        raise StartError(_bad_start_value(one, given, error)) from error


def _descriptor(one: Declaration) -> ParameterDescriptor:
    unit = f" [{one.unit}]" if one.unit else ""
    descriptor = ParameterDescriptor(
        name=one.name,
        description=f"{one.text}{unit}",
        additional_constraints=one.range_text(),
        read_only=not one.dynamic,
    )
    if one.low is None and one.high is None:
        return descriptor
    low = -math.inf if one.low is None else one.low
    high = math.inf if one.high is None else one.high
    if type(one.default) is float:
        descriptor.floating_point_range = [FloatingPointRange(from_value=low, to_value=high)]
    if type(one.default) is int:
        bounds = {
            "from_value": -_LARGEST if math.isinf(low) else int(low),
            "to_value": _LARGEST if math.isinf(high) else int(high),
        }
        descriptor.integer_range = [IntegerRange(step=1, **bounds)]
    return descriptor


def _bad_start_value(one: Declaration, given: Any, error: Exception) -> str:
    """Why a value given at start was refused, in the words of the declaration."""
    if given is not None:
        try:
            one.check(given.value)
        except ParameterError as reason:
            return str(reason)
        value = given.value
        if isinstance(value, int) and isinstance(one.default, float):
            return f"parameter '{one.name}' = {value}: write {value}.0"
        if isinstance(value, Sequence) and all(isinstance(item, int) for item in value):
            decimal = [float(item) for item in value]
            return f"parameter '{one.name}' = {list(value)}: write {decimal}"
    return f"parameter '{one.name}': {error}"
