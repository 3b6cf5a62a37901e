"""The filters of a study by their labels: a name, and settings of its own."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

from dopslam_ros.core.settings.filtering import FilterParameters
from dopslam_ros.core.settings.parameters import (
    ParameterError,
    checked_values,
    parse_assignments,
    unknown_name,
)
from dopslam_ros.lab.study.estimators import (
    DeadReckoning,
    Estimator,
    GenieEstimator,
    PhdEstimator,
    SessionEstimator,
)
from dopslam_ros.simulation.matched import filter_parameters_for
from dopslam_ros.simulation.scenario import Scenario


class Kind(NamedTuple):
    """A filter that can be studied, one of ``names.FILTERS``.

    Attributes:
        fixed: the settings that make it what its name says.
        make: from the scene and the filter's parameters.
    """

    fixed: Mapping[str, object]
    make: Callable[[Scenario, FilterParameters], Estimator]


KINDS: dict[str, Kind] = {
    "joint": Kind(
        {"coupling": "joint", "density": "pmb"},
        SessionEstimator,
    ),
    "marginal": Kind(
        {"coupling": "marginal", "density": "pmb"},
        SessionEstimator,
    ),
    "pmbm": Kind(
        {"density": "pmbm"},
        SessionEstimator,
    ),
    "phd": Kind({}, PhdEstimator),
    "genie": Kind({}, GenieEstimator),
    "dead_reckoning": Kind({}, DeadReckoning),
}


def make_estimator(label: str, scenario: Scenario, settings: Mapping[str, object]) -> Estimator:
    """The filter that a label names, knowing the models of the scene.

    Args:
        label: a name of KINDS, or with settings of its own, as in ``joint:gamma=20``.
        scenario: the scene, with the Doppler noise of the run.
        settings: of all filters; those of the label come first.

    Raises:
        ParameterError: unknown name, or a value that cannot be used.
    """
    kind, own = parse_label(label)
    _refuse_contradiction(label, kind, settings)
    values = {**settings, **own, **kind.fixed}
    return kind.make(scenario, filter_parameters_for(scenario, **values))


def check_label(label: str, settings: Mapping[str, object]) -> None:
    """Raises ParameterError if ``make_estimator`` would."""
    kind, _ = parse_label(label)
    _refuse_contradiction(label, kind, settings)


def parse_label(label: str) -> tuple[Kind, dict[str, object]]:
    """The filter that a label names and the settings it gives it.

    Raises:
        ParameterError: unknown name, or a value that cannot be used.
    """
    name, colon, text = label.partition(":")
    if name not in KINDS:
        raise ParameterError(unknown_name("filter", name, KINDS))
    try:
        values: dict[str, object] = {
            **checked_values(FilterParameters, parse_assignments(text) if colon else {})
        }
    except ParameterError as error:
        raise ParameterError(f"filter '{label}': {error}") from error
    _refuse_contradiction(label, KINDS[name], values)
    return KINDS[name], values


def _refuse_contradiction(label: str, kind: Kind, settings: Mapping[str, object]) -> None:
    for name, value in kind.fixed.items():
        if settings.get(name, value) != value:
            raise ParameterError(
                f"filter '{label}' has {name} = {value}, not {settings[name]}: leave the setting"
                f" out, or name another filter ({', '.join(KINDS)})"
            )
