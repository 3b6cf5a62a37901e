"""A scene to simulate: models, landmarks and what the vehicle drives, read from a YAML file."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from dopslam_ros.core.linalg.arrays import BoolArray, FloatArray, IntArray
from dopslam_ros.core.models.motion import Control
from dopslam_ros.core.settings.layout import LandmarkType
from dopslam_ros.core.settings.model import ModelParameters
from dopslam_ros.core.settings.parameters import (
    ParameterError,
    from_mapping,
    parameter,
    to_mapping,
    unknown_name,
)
from dopslam_ros.simulation.scenes import builtin_scenarios, builtin_text

# The first snapshot of a simulation; not zero, because zero means "no time" in ROS.
START_NS = 1_000_000_000


class ScenarioError(ParameterError):
    """A scenario file cannot be used; the message says where and why."""


class Blockage(NamedTuple):
    """Something in the way of a path for a while, the end not included.

    Attributes:
        source: 0 the BS, i the i-th landmark (from 1).
        begin: since the first snapshot [s].
        end: since the first snapshot [s].
    """

    source: int
    begin: float
    end: float


@dataclasses.dataclass(frozen=True)
class Scenario(ModelParameters):
    """A scene: the models, the true landmarks and the controls.

    Attributes:
        landmarks: (I, 3) true positions of VAs and SPs [m] (the BS is in the model).
        landmark_types: (I,) VA or SP.
        controls: (K,) the control from snapshot k to the next.
        blocked: when which source has no path, wherever the vehicle is.
    """

    name: str = parameter("paper", "Name of the scene.")
    period: float = parameter(0.5, "Time between snapshots, T.", unit="s", low=1e-6, high=3600.0)
    seed: int = parameter(1, "Seed of the random generator.", low=0)
    landmarks: FloatArray = dataclasses.field(default_factory=lambda: np.zeros((0, 3)))
    landmark_types: IntArray = dataclasses.field(
        default_factory=lambda: np.zeros(0, dtype=np.int64)
    )
    controls: tuple[Control, ...] = ()
    blocked: tuple[Blockage, ...] = ()

    @property
    def steps(self) -> int:
        """K, the number of snapshots."""
        return len(self.controls)

    @property
    def period_ns(self) -> int:
        """T in nanoseconds."""
        return round(self.period * 1e9)

    def stamp_ns(self, step: int) -> int:
        """Time of snapshot ``step`` (0, 1, ...) [ns]."""
        return START_NS + step * self.period_ns

    def blocked_at(self, step: int) -> BoolArray:
        """(1 + I,) which sources, the BS first, are blocked at snapshot ``step`` (0, 1, ...)."""
        since = step * self.period_ns
        sources = [
            blockage.source
            for blockage in self.blocked
            if round(blockage.begin * 1e9) <= since < round(blockage.end * 1e9)
        ]
        return np.isin(np.arange(1 + len(self.landmark_types)), sources)


def load_scenario(source: str | Path) -> Scenario:
    """Reads a scene from a YAML file, or one that comes with the package by its name.

    Raises:
        ScenarioError: no such file, not YAML, unknown key, bad value.
    """
    path = Path(source)
    if path.suffix in (".yaml", ".yml"):
        try:
            text = path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise ScenarioError(f"scenario file '{path}' cannot be read: {error}") from error
    elif str(source) in builtin_scenarios():
        text = builtin_text(str(source))
    else:
        hint = unknown_name("scenario", str(source), builtin_scenarios())
        raise ScenarioError(f"{hint} (or give the path of a .yaml file)")
    try:
        return parse_scenario(_with_base(yaml.safe_load(text)))
    except yaml.YAMLError as error:
        raise ScenarioError(f"scenario '{source}' is not YAML: {error}") from error
    except ParameterError as error:
        raise ScenarioError(f"scenario '{source}': {error}") from error


def _with_base(content: Any) -> Any:
    """A file that says ``base: NAME`` changes values of a scene that comes with the package."""
    if not isinstance(content, Mapping) or "base" not in content:
        return content
    base = str(content["base"])
    if base not in builtin_scenarios():
        raise ScenarioError(unknown_name("base scenario", base, builtin_scenarios()))
    own = {key: value for key, value in content.items() if key != "base"}
    return {**_with_base(yaml.safe_load(builtin_text(base))), **own}


def parse_scenario(content: object) -> Scenario:
    """A scene from the content of a YAML file.

    Raises:
        ScenarioError: a part is missing or malformed.
        ParameterError: a parameter has an unknown name or a bad value.
    """
    if not isinstance(content, Mapping):
        raise ScenarioError("the file must hold 'name: value' lines at its top level")
    values: dict[str, Any] = dict(content)
    positions, types = _parse_landmarks(values.pop("landmarks", []))
    controls = _parse_controls(values.pop("controls", []))
    blocked = _parse_blocked(values.pop("blocked", []), len(types))
    return from_mapping(
        Scenario,
        values,
        landmarks=positions,
        landmark_types=types,
        controls=controls,
        blocked=blocked,
    )


def scenario_content(scenario: Scenario) -> dict[str, Any]:
    """The content of a YAML file that ``parse_scenario`` makes the same scene of."""
    places = zip(scenario.landmark_types.tolist(), scenario.landmarks.tolist(), strict=True)
    return {
        **to_mapping(scenario),
        "landmarks": [{"type": LandmarkType(t).name, "position": p} for t, p in places],
        "controls": [
            {"steps": len(list(group)), **control._asdict()}
            for control, group in itertools.groupby(scenario.controls)
        ],
        "blocked": [
            {"landmark": source or "BS", "from": begin, "to": end}
            for source, begin, end in scenario.blocked
        ],
    }


def _parse_landmarks(entries: object) -> tuple[FloatArray, IntArray]:
    if not isinstance(entries, list):
        raise ScenarioError("'landmarks' must be a list of {type: VA or SP, position: [x, y, z]}")
    positions, types = [], []
    for number, entry in enumerate(entries, start=1):
        where = f"landmark {number} of {len(entries)}"
        kind = _entry(entry, where, ("type", "position"))["type"]
        if kind not in ("VA", "SP"):
            raise ScenarioError(f"{where}: type {kind!r} must be VA or SP")
        positions.append(_numbers(entry["position"], 3, f"{where}: position"))
        types.append(int(LandmarkType[kind]))
    return np.reshape(np.array(positions, dtype=np.float64), (-1, 3)), np.array(types, np.int64)


def _parse_controls(entries: object) -> tuple[Control, ...]:
    if not isinstance(entries, list) or not entries:
        raise ScenarioError("'controls' must be a list of {steps: n, speed: m/s, turn_rate: rad/s}")
    controls: list[Control] = []
    for number, entry in enumerate(entries, start=1):
        where = f"control {number} of {len(entries)}"
        steps = _entry(entry, where, ("steps", "speed", "turn_rate"))["steps"]
        if not isinstance(steps, int) or isinstance(steps, bool) or not 1 <= steps <= 10_000_000:
            raise ScenarioError(f"{where}: steps {steps!r} must be a whole number from 1 on")
        speed, turn_rate = _numbers([entry["speed"], entry["turn_rate"]], 2, where)
        controls += [Control(speed, turn_rate)] * steps
    return tuple(controls)


def _parse_blocked(entries: object, landmarks: int) -> tuple[Blockage, ...]:
    if not isinstance(entries, list):
        raise ScenarioError("'blocked' must be a list of {landmark: BS or number, from: s, to: s}")
    blocked: list[Blockage] = []
    for number, entry in enumerate(entries, start=1):
        where = f"blockage {number} of {len(entries)}"
        source = _entry(entry, where, ("landmark", "from", "to"))["landmark"]
        if source != "BS" and (
            not isinstance(source, int) or isinstance(source, bool) or not 1 <= source <= landmarks
        ):
            raise ScenarioError(
                f"{where}: landmark {source!r} must be BS or the number, from 1, of one of the"
                f" {landmarks} landmarks"
            )
        begin, end = _numbers([entry["from"], entry["to"]], 2, where)
        if not 0.0 <= begin < end:
            raise ScenarioError(
                f"{where}: from {begin:g} to {end:g} must be seconds since the first snapshot,"
                " the earlier time first"
            )
        blocked.append(Blockage(0 if source == "BS" else source, begin, end))
    return tuple(blocked)


def _entry(entry: object, where: str, keys: tuple[str, ...]) -> Mapping[str, Any]:
    if not isinstance(entry, Mapping):
        raise ScenarioError(f"{where}: {entry!r} must be {{{', '.join(keys)}}}")
    for key in entry:
        if key not in keys:
            raise ScenarioError(f"{where}: " + unknown_name("key", str(key), keys))
    for key in keys:
        if key not in entry:
            raise ScenarioError(f"{where}: '{key}' is missing")
    return entry


def _numbers(value: object, size: int, where: str) -> list[float]:
    if not isinstance(value, list) or len(value) != size:
        raise ScenarioError(f"{where}: {value!r} must be {size} numbers")
    for item in value:
        if isinstance(item, bool) or not isinstance(item, (int, float)) or not np.isfinite(item):
            raise ScenarioError(f"{where}: {item!r} must be a finite number")
    return [float(item) for item in value]
