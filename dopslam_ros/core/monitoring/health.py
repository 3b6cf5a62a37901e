"""Whether the filter still knows where it is: fine, doubtful, or lost, and why.

A step is assessed by what it expected to hear and heard, by how well it fitted (NIS) and by how
sure the filter is. Single sets mean little, so figures are averaged with a fading memory of some 20
sets. The CUSUM, the sum of ln p(set | lost) - ln p(set | found), never below zero, is Page's test
for the moment at which the vehicle was lost. While all is well a step takes it over ``LOST_AT``
with a probability below e^-LOST_AT.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum

from dopslam_ros.core.linalg.arrays import FloatArray
from dopslam_ros.core.monitoring.cusum import SetStatistics, set_statistics
from dopslam_ros.core.pmb import Associations, FilterParameters
from dopslam_ros.core.pmb.likelihood import Observed
from dopslam_ros.core.settings.layout import X, Y

# CUSUM [nat] from which on it is told, and from which on the vehicle counts as lost.
WARN_AT, LOST_AT = 6.0, 10.0
# With less than this to hear, nothing heard says nothing.
FEWEST_EXPECTED = 2.0
# Share of a figure that is left after a step: a memory of 20 steps.
FADING = 0.95
# So many standard deviations are more than chance.
MORE_THAN_CHANCE = 5.0
# The line of sight is missed once it was not heard for so many sets in a row, though expected.
LONGEST_SILENCE = 10


class Level(IntEnum):
    """The numbers are those of diagnostic_msgs."""

    OK = 0
    WARN = 1
    LOST = 2


@dataclass(frozen=True)
class Faded:
    """Sums over steps, the past fading.

    Attributes:
        nis: of the innovations squared.
        dof: their expectation.
        nis_variance: of ``nis``.
        heard: of the sources heard.
        expected: their expectation.
        heard_variance: of ``heard``.
        clutter: of the clutter paths.
        clutter_expected: their expectation, and variance before fading.
        clutter_variance: of ``clutter``.
    """

    nis: float = 0.0
    dof: float = 0.0
    nis_variance: float = 0.0
    heard: float = 0.0
    expected: float = 0.0
    heard_variance: float = 0.0
    clutter: float = 0.0
    clutter_expected: float = 0.0
    clutter_variance: float = 0.0


@dataclass(frozen=True)
class Health:
    """How the filter is after a step.

    Attributes:
        level: OK, WARN or LOST.
        reason: one sentence.
        cusum: ln of the odds of lost against found, added up [nat].
        faded: averages of what was heard and how it fitted.
        silence: sets in a row in which the BS was expected and not heard.
        position_std: root of the trace of the position's covariance [m].
        losses: how often the vehicle was lost so far.
    """

    level: Level = Level.OK
    reason: str = "as expected"
    cusum: float = 0.0
    faded: Faded = Faded()
    silence: int = 0
    position_std: float = 0.0
    losses: int = 0

    @property
    def nis_ratio(self) -> float:
        """NIS over its expectation; 1 where filter and models are right, NaN before any path."""
        return self.faded.nis / self.faded.dof if self.faded.dof > 0.0 else math.nan

    @property
    def heard_ratio(self) -> float:
        """Sources heard over sources expected; NaN before any was."""
        return self.faded.heard / self.faded.expected if self.faded.expected > 0.0 else math.nan

    @property
    def figures(self) -> list[tuple[str, str]]:
        """Names and values for diagnostics."""
        off, faded = _off, self.faded
        return [
            ("health", self.level.name),
            ("cusum", f"{self.cusum:.1f} of {LOST_AT:g}"),
            ("nis_ratio", f"{self.nis_ratio:.3f}"),
            ("nis_deviations", f"{off(faded.nis, faded.dof, faded.nis_variance):.1f}"),
            ("heard_ratio", f"{self.heard_ratio:.3f}"),
            ("sets_without_line_of_sight", str(self.silence)),
            ("position_std", f"{self.position_std:.3f}"),
            ("times_lost", str(self.losses)),
        ]


HEALTHY = Health()


def statistics_of(
    associations: Associations,
    observed: Observed,
    parameters: FilterParameters,
) -> SetStatistics:
    """What a set says of whether the filter knows where it is.

    Args:
        associations: of the set.
        observed: the set.
        parameters: of the filter.
    """
    return set_statistics(
        associations.ids,
        associations.weight,
        associations.sources,
        associations.log_missed,
        associations.log_new,
        -(observed.used @ parameters.clutter_log_spans),
        float(parameters.clutter_mean),
    )


def assess(
    before: Health,
    statistics: SetStatistics,
    associations: Associations,
    covariance: FloatArray,
    parameters: FilterParameters,
) -> Health:
    """The health after a step.

    Args:
        before: health after the step before.
        statistics: of the set.
        associations: of the set.
        covariance: (S, S) of the vehicle after the step.
        parameters: of the filter.
    """
    log_odds = (
        statistics.log_odds
        if statistics.expected >= FEWEST_EXPECTED
        else min(statistics.log_odds, 0.0)
    )
    cusum = max(before.cusum + log_odds, 0.0)
    faded = _faded(before.faded, statistics, associations, parameters)
    heard = statistics.line_of_sight > 0.5
    silence = 0 if heard else before.silence + 1
    position_std = math.sqrt(max(float(covariance[X, X] + covariance[Y, Y]), 0.0))
    level, reason = _verdict(cusum, faded, silence, position_std, statistics, parameters)
    losses = before.losses + (level == Level.LOST)
    return Health(level, reason, cusum, faded, silence, position_std, losses)


def _faded(
    before: Faded,
    statistics: SetStatistics,
    associations: Associations,
    parameters: FilterParameters,
) -> Faded:
    keep, square = FADING, FADING**2
    return Faded(
        nis=keep * before.nis + associations.nis,
        dof=keep * before.dof + associations.nis_dof,
        nis_variance=square * before.nis_variance + 2.0 * associations.nis_dof,
        heard=keep * before.heard + statistics.heard,
        expected=keep * before.expected + statistics.expected,
        heard_variance=square * before.heard_variance + statistics.variance,
        clutter=keep * before.clutter + statistics.clutter,
        clutter_expected=keep * before.clutter_expected + parameters.clutter_mean,
        clutter_variance=square * before.clutter_variance + parameters.clutter_mean,
    )


def _verdict(
    cusum: float,
    faded: Faded,
    silence: int,
    position_std: float,
    statistics: SetStatistics,
    parameters: FilterParameters,
) -> tuple[Level, str]:
    came = f"{statistics.heard:.1f} of {statistics.expected:.1f} expected paths came"
    if cusum >= LOST_AT:
        return Level.LOST, f"lost: {came}, what came is not explained"
    if cusum >= WARN_AT:
        return Level.WARN, f"doubtful: {came}"
    if position_std > parameters.health_position_std:
        return Level.WARN, (
            f"position known to {position_std:.2f} m only, stated are"
            f" {parameters.health_position_std:g} m"
        )
    if _off(faded.nis, faded.dof, faded.nis_variance) > MORE_THAN_CHANCE:
        ratio = faded.nis / faded.dof
        return Level.WARN, f"NIS {ratio:.2f} times its expectation: noise larger than stated?"
    if _off(faded.heard, faded.expected, faded.heard_variance) < -MORE_THAN_CHANCE:
        share = faded.heard / faded.expected
        return Level.WARN, f"only {share:.0%} of the expected paths came: detection_probability?"
    if _off(faded.clutter, faded.clutter_expected, faded.clutter_variance) > MORE_THAN_CHANCE:
        ratio = faded.clutter / faded.clutter_expected
        return Level.WARN, f"{ratio:.1f} times the clutter expected: clutter_mean?"
    if silence >= LONGEST_SILENCE:
        return Level.WARN, f"no line of sight to the base station for {silence} sets"
    return Level.OK, HEALTHY.reason


def _off(value: float, expected: float, variance: float) -> float:
    """How many standard deviations a sum is off."""
    return (value - expected) / math.sqrt(variance) if variance > 0.0 else 0.0
