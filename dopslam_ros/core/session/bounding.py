"""The bounds over time: states and controls in any order go in, bounds in order come out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from dopslam_ros.core.linalg.arrays import BoolArray, FloatArray, IntArray
from dopslam_ros.core.models.channel import Paths, observe
from dopslam_ros.core.models.detection import detection_probabilities
from dopslam_ros.core.pcrb.bounds import (
    Bounds,
    bounds_of,
    initial_bound,
    predict_bound,
    update_bound,
)
from dopslam_ros.core.pcrb.bounds_kernels import BoundState
from dopslam_ros.core.session.sequence import BEGUN_ANEW, Sequencer, Timed
from dopslam_ros.core.settings.bounding import BoundsParameters
from dopslam_ros.core.settings.layout import BS_ID, DOPPLER, LandmarkType, X, Y
from dopslam_ros.core.settings.model import with_doppler_std


@dataclass(frozen=True)
class WorldState:
    """Where vehicle and landmarks are, to evaluate the bounds at.

    Attributes:
        ue: (U,) state of the vehicle.
        ids: (M,) ids of the landmarks.
        types: (M,) LandmarkType; a BS among them or not.
        positions: (M, 3) [m].
        detected: (M,) which had a path, or how likely each was to have one, where that is known;
            None: p_D of the model, in expectation.
    """

    ue: FloatArray
    ids: IntArray
    types: IntArray
    positions: FloatArray
    detected: BoolArray | FloatArray | None = None


@dataclass(frozen=True)
class BoundsOutput:
    """Bounds after a snapshot.

    Attributes:
        stamp_ns: time of the snapshot.
        ids: (M,) landmarks, the BS not among them.
        types: (M,) LandmarkType.
        with_doppler: bounds with everything that is measured.
        without_doppler: the same less the Doppler.
    """

    stamp_ns: int
    ids: IntArray
    types: IntArray
    with_doppler: Bounds
    without_doppler: Bounds


class BoundsSession:
    """The recursion of the PIM fed with states and controls, with and without Doppler."""

    def __init__(self, parameters: BoundsParameters) -> None:
        self.parameters = parameters
        self.problems: Counter[str] = Counter()
        self._models = (parameters, with_doppler_std(parameters, None))
        self._sequencer: Sequencer[WorldState] = Sequencer(parameters)
        self._begin()

    def _begin(self) -> None:
        covariance = self.parameters.initial_covariance
        self._states = [initial_bound(covariance) for _ in self._models]
        self._ue: FloatArray | None = None

    @property
    def pending(self) -> int:
        """States that wait for their control."""
        return self._sequencer.pending

    def add_control(self, stamp_ns: int, speed: float, turn_rate: float) -> Iterator[BoundsOutput]:
        """A control; yields the bounds it was waited for. Raises Refused."""
        self._sequencer.add_control(stamp_ns, speed, turn_rate)
        return map(self._step, self._sequencer.ready())

    def add_world(self, stamp_ns: int, world: WorldState) -> Iterator[BoundsOutput]:
        """The state at a snapshot; yields the bounds that are due. Raises Refused."""
        self._sequencer.add(stamp_ns, world)
        return map(self._step, self._sequencer.ready())

    def end(self) -> Iterator[BoundsOutput]:
        """Processes what still waits: no more inputs will come."""
        yield from map(self._step, self._sequencer.end())
        self.problems.update(self._sequencer.take_problems())

    def _step(self, timed: Timed[WorldState]) -> BoundsOutput:
        self.problems.update(self._sequencer.take_problems())
        if not timed.complete:
            self.problems["missing_control"] += 1
        if timed.anew:
            self.problems[BEGUN_ANEW] += 1
            self._begin()
        world, model = timed.item, self.parameters
        # The BS takes part once, whether or not the map lists it.
        others = world.types != LandmarkType.BS
        ids = np.concatenate(([BS_ID], world.ids[others]))
        types = np.concatenate(([int(LandmarkType.BS)], world.types[others]))
        positions = np.concatenate((model.bs[None], world.positions[others]))
        speed = timed.control.speed if timed.control else 0.0
        paths = observe(world.ue, speed, positions, types, model.bs, model.ue_height)
        weights = self._weights(world, positions, types, paths)
        self._states = [
            self._updated(state, variant, timed, paths, ids, types, weights)
            for state, variant in zip(self._states, self._models, strict=True)
        ]
        self._ue = world.ue
        full, plain = (bounds_of(state, ids[1:]) for state in self._states)
        return BoundsOutput(timed.stamp_ns, ids[1:], types[1:], full, plain)

    def _weights(
        self, world: WorldState, positions: FloatArray, types: IntArray, paths: Paths
    ) -> FloatArray:
        """(M,) share of the information of each landmark that counts, the BS first."""
        if world.detected is None:
            ue = np.array([world.ue[X], world.ue[Y], self.parameters.ue_height])
            return detection_probabilities(self.parameters, ue, positions, types) * paths.facing
        others = world.types != LandmarkType.BS
        of_bs = world.detected[~others].max(initial=0)
        return np.concatenate(([of_bs], world.detected[others]))

    def _updated(
        self,
        state: BoundState,
        variant: BoundsParameters,
        timed: Timed[WorldState],
        paths: Paths,
        ids: IntArray,
        types: IntArray,
        weights: FloatArray,
    ) -> BoundState:
        """The PIM of one variant of the models after a snapshot."""
        if self._ue is not None:
            state = predict_bound(state, self._ue, timed.spans, variant.noise_rate)
        used = variant.used_components
        if timed.control is None or timed.stale:
            used = used & (np.arange(len(used)) != DOPPLER)
        return update_bound(state, paths, ids, types, weights, variant.noise, used)
