"""A filter that knows which path came from which landmark: the best any association can do.

A baseline for studies and the oracle that the bounds are checked against. It is told the true
source of every path.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dopslam_ros.core.linalg.arrays import FloatArray, IntArray, symmetrise, wrap_angle
from dopslam_ros.core.models.channel import observe
from dopslam_ros.core.models.measurements import MeasurementSet
from dopslam_ros.core.models.motion import ControlSpan
from dopslam_ros.core.pcrb.bounds_kernels import DIFFUSE_STD
from dopslam_ros.core.pmb import LandmarkEstimates, coordinates
from dopslam_ros.core.pmb.likelihood import Observed
from dopslam_ros.core.pmb.observed import prepare
from dopslam_ros.core.pmb.posterior import initial_density
from dopslam_ros.core.settings.filtering import FilterParameters
from dopslam_ros.core.settings.layout import DIM, HEADING, SPACE, UNKNOWN_TYPES, LandmarkType
from dopslam_ros.lab.baselines.births import propose
from dopslam_ros.lab.baselines.gaussian import masked_residual
from dopslam_ros.lab.baselines.prediction import predict
from dopslam_ros.simulation.simulator import CLUTTER

ITERATIONS = 5


@dataclass(frozen=True)
class GenieState:
    """Joint Gaussian over [s; q of the landmarks seen], q as in ``core.pmb.coordinates``.

    Attributes:
        mean: (U + 3 L,).
        covariance: (U + 3 L, U + 3 L).
        origin: (L, 3) of the landmarks' frames [m].
        axes: (L, 3, 3).
        sources: (L,) source number of each landmark, as in Snapshot.sources.
    """

    mean: FloatArray
    covariance: FloatArray
    origin: FloatArray
    axes: FloatArray
    sources: IntArray

    @property
    def vehicle(self) -> int:
        """U, how many numbers the vehicle has."""
        return len(self.mean) - SPACE * len(self.sources)

    @property
    def local(self) -> FloatArray:
        """(L, 3) q of the landmarks."""
        return self.mean[self.vehicle :].reshape(-1, SPACE)

    @property
    def positions(self) -> FloatArray:
        """(L, 3) of the landmarks [m]."""
        return coordinates.positions(self.origin, self.axes, self.local)

    @property
    def position_covariances(self) -> FloatArray:
        """(L, 3, 3) of the positions, to first order [m^2]."""
        index = self.columns(np.arange(len(self.sources)))
        blocks = self.covariance[index[:, :, None], index[:, None, :]]
        jacobian = coordinates.jacobians(self.axes, self.local)
        return symmetrise(jacobian @ blocks @ np.swapaxes(jacobian, 1, 2))

    def columns(self, landmarks: IntArray) -> IntArray:
        """(n, 3) where landmarks (n,) stand in the joint vector."""
        return self.vehicle + SPACE * landmarks[:, None] + np.arange(SPACE)


def initial_genie(parameters: FilterParameters) -> GenieState:
    """The prior of the vehicle, no landmark."""
    return GenieState(
        np.array(parameters.initial_state),
        parameters.initial_covariance,
        np.zeros((0, 3)),
        np.zeros((0, 3, 3)),
        np.zeros(0, dtype=np.int64),
    )


def genie_step(
    state: GenieState,
    measurements: MeasurementSet,
    sources: IntArray,
    types: IntArray,
    spans: Sequence[ControlSpan],
    speed: float,
    parameters: FilterParameters,
) -> GenieState:
    """Predict, then one iterated joint EKF update with the true association.

    Args:
        state: before.
        measurements: the snapshot, J paths.
        sources: (J,) true source of each path: 0 the BS, i landmark i, or CLUTTER.
        types: (1 + I,) true types by source number.
        spans: controls since the previous snapshot.
        speed: v at the snapshot [m/s].
        parameters: models.
    """
    mean, covariance = predict(state.mean, state.covariance, spans, parameters)
    real = sources != CLUTTER
    observed = prepare(
        MeasurementSet(measurements.values[real], measurements.covariances[real]), parameters
    )
    predicted = replace(state, mean=mean, covariance=covariance)
    ready, kept = _with_new_landmarks(predicted, observed, sources[real], types, speed, parameters)
    observed = Observed(observed.values[kept], observed.used[kept], observed.noise[kept])
    return _update(ready, observed, sources[real][kept], types, speed, parameters)


def genie_landmarks(
    state: GenieState, types: IntArray, parameters: FilterParameters
) -> LandmarkEstimates:
    """The landmarks seen whose position is known as well as the other filters must know it.

    Args:
        state: after a step.
        types: (1 + I,) true types by source number.
        parameters: with ``report_std``.
    """
    covariances = state.position_covariances
    shown = np.sqrt(np.trace(covariances, axis1=1, axis2=2)) <= parameters.report_std
    kinds = types[state.sources[shown]]
    return LandmarkEstimates(
        ids=state.sources[shown],
        types=kinds,
        type_probabilities=np.eye(len(LandmarkType))[kinds],
        existence=np.ones(len(kinds)),
        positions=state.positions[shown],
        covariances=covariances[shown],
    )


def _with_new_landmarks(
    state: GenieState,
    observed: Observed,
    sources: IntArray,
    types: IntArray,
    speed: float,
    parameters: FilterParameters,
) -> tuple[GenieState, IntArray]:
    """Appends landmarks never seen, diffuse, where their path puts them; and the usable paths."""
    base = initial_density(parameters).but(
        mean=state.mean[: state.vehicle],
        covariance=state.covariance[: state.vehicle, : state.vehicle],
    )
    births = propose(base, observed, speed, parameters)
    new, kept = [], []
    for path, source in enumerate(sources.tolist()):
        if source == 0 or source in state.sources:
            kept.append(path)
            continue
        kind = UNKNOWN_TYPES.index(int(types[source]))
        if np.isfinite(births.log_intensity[kind, path]):
            kept.append(path)
            new.append((source, births.position[kind, path]))
    position = np.array([position for _, position in new]).reshape(-1, SPACE)
    origin = np.tile(np.append(state.mean[:2], parameters.ue_height), (len(new), 1))
    axes = coordinates.frames(position - origin)
    q = coordinates.local_coordinates(origin, axes, position)
    std = DIFFUSE_STD / np.stack([np.ones(len(new)), q[:, 0], q[:, 0]], axis=1)
    old = len(state.mean)
    covariance = np.diag(np.concatenate([np.zeros(old), std.ravel() ** 2]))
    covariance[:old, :old] = state.covariance
    ready = GenieState(
        mean=np.concatenate([state.mean, q.ravel()]),
        covariance=covariance,
        origin=np.concatenate([state.origin, origin]),
        axes=np.concatenate([state.axes, axes]),
        sources=np.concatenate([state.sources, [source for source, _ in new]]).astype(np.int64),
    )
    return ready, np.array(kept, dtype=np.int64)


def _update(
    state: GenieState,
    observed: Observed,
    sources: IntArray,
    types: IntArray,
    speed: float,
    parameters: FilterParameters,
) -> GenieState:
    """The iterated EKF update of vehicle and landmarks with J paths of known sources (J,)."""
    if not len(sources):
        return state
    size, count = len(state.mean), len(sources)
    noise = np.zeros((count * DIM, count * DIM))
    for number in range(count):
        block = slice(DIM * number, DIM * number + DIM)
        noise[block, block] = observed.noise[number]
    mean = state.mean
    for _ in range(ITERATIONS):
        about = replace(state, mean=mean)
        rows, innovation = _linearised(about, observed, sources, types, speed, parameters)
        innovation = innovation + rows @ _difference(mean, state.mean)
        projected = rows @ state.covariance
        gain = np.linalg.solve(symmetrise(projected @ rows.T + noise), projected).T
        mean = state.mean + gain @ innovation
    keep = np.eye(size) - gain @ rows
    covariance = symmetrise(keep @ state.covariance @ keep.T + gain @ noise @ gain.T)
    mean[HEADING] = wrap_angle(mean[HEADING])
    return replace(state, mean=mean, covariance=covariance)


def _linearised(
    state: GenieState,
    observed: Observed,
    sources: IntArray,
    types: IntArray,
    speed: float,
    parameters: FilterParameters,
) -> tuple[FloatArray, FloatArray]:
    """H (6 J, n) and the innovations (6 J,) of all paths at the mean of a state."""
    vehicle, q = state.vehicle, state.local
    is_bs = sources == 0
    # Row 0 is the BS, then the landmarks.
    row = np.array(
        [0 if s == 0 else 1 + int(np.flatnonzero(state.sources == s)[0]) for s in sources]
    )
    columns = state.columns(row - 1)
    kinds = np.where(is_bs, int(LandmarkType.BS), types[sources])
    positions = np.vstack([parameters.bs, state.positions])[row]
    ue, height = state.mean[:vehicle], parameters.ue_height
    paths = observe(ue, speed, positions, kinds, parameters.bs, height)
    to_position = coordinates.jacobians(state.axes, q)
    blocks = np.zeros((len(sources), DIM, len(state.mean)))
    blocks[:, :, :vehicle] = paths.ue_jacobian
    for path in np.flatnonzero(~is_bs):
        blocks[path][:, columns[path]] = paths.landmark_jacobian[path] @ to_position[row[path] - 1]
    rows = (blocks * observed.used[:, :, None]).reshape(-1, len(state.mean))
    return rows, masked_residual(observed, paths.mean).ravel()


def _difference(mean: FloatArray, prior: FloatArray) -> FloatArray:
    difference = mean - prior
    difference[HEADING] = wrap_angle(difference[HEADING])
    return difference
