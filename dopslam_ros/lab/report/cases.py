"""What is compared: bags, each as recorded or set otherwise, one run or several under a name."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from dopslam_ros.bag import BagMessage, BagReader
from dopslam_ros.core.pmb import FilterParameters
from dopslam_ros.core.settings.model import with_doppler_std
from dopslam_ros.core.settings.parameters import ParameterError, checked_values, parse_assignments
from dopslam_ros.offline.replay import recorded_parameters, replay
from dopslam_ros.offline.replay_result import Replay
from dopslam_ros.system.errors import UsageError

# A setting of its own beside the filter's parameters: a noise in m/s, or none.
DOPPLER = "doppler"
_WRITTEN = re.compile(r"(?:(?P<name>[^/:=]+)=)?(?P<path>.+?)(?::(?P<settings>\w+\s*=.*))?")


class Wanted(NamedTuple):
    """A case as asked for.

    Attributes:
        label: its name on the table.
        bags: one for each run.
        settings: of the filter, as they were written.
    """

    label: str
    bags: tuple[Path, ...]
    settings: dict[str, object]


class Case(NamedTuple):
    """A case as run.

    Attributes:
        label: its name on the table.
        runs: what came out of each bag.
    """

    label: str
    runs: tuple[Replay, ...]


def parse_case(text: str) -> Wanted:
    """The case that ``[NAME=]BAG[:SETTING=VALUE,...]`` asks for.

    BAG is a bag, or a folder of bags: a run each. A setting is a parameter of the filter, or
    ``doppler``: its standard deviation [m/s], or ``none`` to leave the Doppler out.

    Raises:
        UsageError: a setting cannot be used.
    """
    name, path, settings = None, text, None
    if not Path(text).exists():
        found = _WRITTEN.fullmatch(text)
        assert found is not None  # any text is at least a path
        name, path, settings = found["name"], found["path"], found["settings"]
    try:
        values = parse_assignments(settings) if settings else {}
        _filter_settings(values, FilterParameters())
    except (ParameterError, ValueError) as error:
        raise UsageError(f"{text}: {error}") from error
    return Wanted(name or text, bags_in(Path(path)), values)


def bags_in(path: Path) -> tuple[Path, ...]:
    """The bag at a path, or those in a folder that is none itself."""
    if path.is_dir() and not (path / "metadata.yaml").exists() and not any(path.glob("*.mcap")):
        inside = sorted(p for p in path.iterdir() if p.is_dir() and any(p.glob("*.mcap")))
        if inside:
            return tuple(inside)
    return (path,)


def grouped(wanted: Iterable[Wanted]) -> list[tuple[str, list[tuple[Path, dict[str, object]]]]]:
    """The runs of each label, in the order in which the labels came.

    Raises:
        UsageError: there are not two of them, or they have different numbers of runs.
    """
    groups: dict[str, list[tuple[Path, dict[str, object]]]] = {}
    for label, bags, settings in wanted:
        groups.setdefault(label, []).extend((bag, settings) for bag in bags)
    if len(groups) < 2:
        raise UsageError("nothing to compare with: give two bags, or one bag set two ways")
    counts = {label: len(runs) for label, runs in groups.items()}
    if len(set(counts.values())) > 1:
        listed = ", ".join(f"{label}: {count}" for label, count in counts.items())
        raise UsageError(f"the same number of runs is needed under each name, not {listed}")
    return list(groups.items())


def run_cases(
    wanted: Sequence[Wanted],
    common: dict[str, Any],
    progress: Callable[[Iterable[BagMessage]], Iterable[BagMessage]] = iter,
) -> list[Case]:
    """Filters every bag of every case.

    Args:
        wanted: the cases.
        common: settings of all of them; those of a case come first.
        progress: wraps the iteration over the messages of a bag.

    Raises:
        UsageError, ReplayError, ParameterError, BagError: it cannot be done.
    """

    def run(bag: Path, settings: dict[str, object]) -> Replay:
        reader = BagReader(bag)
        own = _filter_settings(settings, recorded_parameters(reader))
        found = replay(reader, {**common, **own}, None, progress)
        if not found.outputs:
            raise UsageError(f"bag '{bag}' has no measurement set that can be filtered")
        return found

    return [
        Case(label, tuple(run(bag, settings) for bag, settings in runs))
        for label, runs in grouped(wanted)
    ]


def _filter_settings(written: dict[str, object], recorded: FilterParameters) -> dict[str, Any]:
    """The filter's parameters that settings stand for. Raises ParameterError."""
    values = {name: value for name, value in written.items() if name != DOPPLER}
    settings: dict[str, Any] = dict(checked_values(FilterParameters, values))
    if DOPPLER in written:
        sigma = written[DOPPLER]
        if sigma == "none":
            sigma = None
        elif isinstance(sigma, bool) or not isinstance(sigma, (int, float)) or not sigma > 0.0:
            raise ParameterError(f"doppler={sigma}: give a standard deviation [m/s], or none")
        changed = with_doppler_std(recorded, sigma)
        settings["measurement_noise_std"] = changed.measurement_noise_std
    return settings
