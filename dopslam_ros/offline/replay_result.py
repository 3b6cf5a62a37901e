"""What comes out of a bag that is filtered offline."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any

from dopslam_ros.core.linalg.arrays import FloatArray
from dopslam_ros.core.pcrb.bounds import Bounds
from dopslam_ros.core.pmb import FilterParameters
from dopslam_ros.core.session.bounding import BoundsOutput
from dopslam_ros.core.session.checkpoint import Checkpoint
from dopslam_ros.core.session.output import FilterOutput
from dopslam_ros.core.settings.layout import LandmarkType
from dopslam_ros.messages.states import MapArrays
from dopslam_ros.offline.evaluation import StepRecord, judge_step, summarise


@dataclass
class Replay:
    """What came out of a bag.

    Attributes:
        parameters: what the filter was set to.
        outputs: of the filter, in order.
        bounds: by stamp [ns].
        truth: (U,) true states by stamp [ns].
        true_map: the true landmarks, if the bag has them.
        problems: how often each kind of input was refused, or another problem was met.
        damage: what of the bag could not be read, in a sentence.
        known_map: the map at the end.
    """

    parameters: FilterParameters
    outputs: list[FilterOutput] = field(default_factory=list)
    bounds: dict[int, BoundsOutput] = field(default_factory=dict)
    truth: dict[int, FloatArray] = field(default_factory=dict)
    true_map: MapArrays | None = None
    problems: Counter[str] = field(default_factory=Counter)
    damage: str | None = None
    known_map: Checkpoint | None = None

    def records(self) -> list[StepRecord]:
        """Each step judged against the truth, as far as the bag has it."""
        vas = sps = None
        if self.true_map is not None:
            vas = self.true_map.of_type(LandmarkType.VA)
            sps = self.true_map.of_type(LandmarkType.SP)
        return [
            judge_step(
                output.state.ue_mean,
                output.state.ue_covariance,
                output.landmarks,
                self.truth.get(output.stamp_ns),
                vas,
                sps,
                self._bound_at(output.stamp_ns),
                seconds=output.step_seconds,
            )
            for output in self.outputs
        ]

    def summary(self) -> dict[str, Any]:
        """How good it was, and what was wrong with the bag, as ``--json`` has it."""
        summary = summarise(self.records())
        summary["problems"] = dict(sorted(self.problems.items()))
        if self.damage:
            summary["damage"] = self.damage
        return summary

    def _bound_at(self, stamp: int) -> Bounds | None:
        """With the components that the filter used: without Doppler if it used none."""
        bound = self.bounds.get(stamp)
        return None if bound is None else bound.with_doppler
