"""What is on the map at each step: vehicle, landmarks and the way of every path, as flat tables."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from enum import IntEnum

import numpy as np

from dopslam_ros.core.linalg.arrays import FloatArray, IntArray
from dopslam_ros.core.models.channel import incidence_points
from dopslam_ros.core.pmb import LandmarkEstimates
from dopslam_ros.core.pmb.estimates import reported_landmarks
from dopslam_ros.core.session.output import FilterOutput
from dopslam_ros.core.settings.layout import COMPONENTS, NONE, VEHICLE, LandmarkType
from dopslam_ros.lab.report.series import Series
from dopslam_ros.offline.replay_result import Replay

# What is not reported as a landmark yet is shown from this probability of existence on, when its
# place is not worse known than so many times report_std.
CANDIDATE_EXISTENCE = 0.05
CANDIDATE_STD = 3.0
# Length of the stub that shows from where an unexplained path came, over the size of the scene.
STUB = 0.06


class Source(IntEnum):
    """What a path was taken for."""

    LOS = 0
    VA = 1
    SP = 2
    NEW = 3
    CLUTTER = 4


NAMES = {
    Source.LOS: "line of sight",
    Source.VA: "wall (VA)",
    Source.SP: "object (SP)",
    Source.NEW: "new landmark",
    Source.CLUTTER: "clutter",
}
_SOURCE_OF_TYPE = {
    int(LandmarkType.BS): Source.LOS,
    int(LandmarkType.VA): Source.VA,
    int(LandmarkType.SP): Source.SP,
}


def scene_of(run: Replay) -> Series:
    """The tables of the map.

    Returns:
        x, y, heading, clock and pxx, pxy, pyy: of the vehicle, (K,); true_...: NaN without truth.
        landmark_...: a row for each landmark and step, those of step k from ``landmark_start[k]``
            to ``landmark_start[k + 1]``.
        path_...: a row for each path and step, likewise: its source, the id of its landmark (0 the
            base station, -1 none), the probability of that, the point over which it came
            (``path_x``, ``path_y``) and what was measured.
    """
    outputs = run.outputs
    states = np.array([o.state.ue_mean for o in outputs]).reshape(-1, len(VEHICLE))
    unknown = np.full(len(VEHICLE), np.nan)
    truth = np.array([run.truth.get(o.stamp_ns, unknown) for o in outputs]).reshape(
        -1, len(VEHICLE)
    )
    covariances = np.array([o.state.ue_covariance[:2, :2] for o in outputs]).reshape(-1, 2, 2)
    everything = [_every_track(output) for output in outputs]
    stub = STUB * _size(run, states)
    names = ("x", "y", "heading", "clock")
    return {
        **{name: states[:, column] for column, name in enumerate(names)},
        **{f"true_{name}": truth[:, column] for column, name in enumerate(names)},
        "pxx": covariances[:, 0, 0],
        "pxy": covariances[:, 0, 1],
        "pyy": covariances[:, 1, 1],
        **_landmarks(everything, run),
        **_ragged("path", [_paths(o, e, stub) for o, e in zip(outputs, everything, strict=True)]),
    }


def extent_of(run: Replay, scene: Series) -> tuple[float, float, float, float]:
    """x from, x to, y from, y to of what is worth seeing [m]."""
    reported = scene["landmark_reported"] > 0.0
    points = [
        np.column_stack([scene["x"], scene["y"]]),
        np.column_stack([scene["true_x"], scene["true_y"]]),
        np.column_stack([scene["landmark_x"], scene["landmark_y"]])[reported],
        run.parameters.bs[None, :2],
    ]
    if run.true_map is not None:
        points.append(run.true_map.positions[:, :2])
    everything = np.vstack(points)
    everything = everything[np.isfinite(everything).all(axis=1)]
    low, high = everything.min(axis=0), everything.max(axis=0)
    margin = 0.06 * max(float((high - low).max()), 1.0)
    low, high = low - margin, high + margin
    return float(low[0]), float(high[0]), float(low[1]), float(high[1])


def _size(run: Replay, states: FloatArray) -> float:
    """Roughly how large the scene is [m]."""
    points = np.vstack([states[:, :2], run.parameters.bs[None, :2]])
    return float(np.ptp(points, axis=0).max()) * 2.0 or 100.0


def _every_track(output: FilterOutput) -> LandmarkEstimates:
    """All landmarks that the filter thinks of, reported or not."""
    all_of_them = replace(output.parameters, report_existence=0.0, report_std=np.inf)
    return reported_landmarks(output.state, all_of_them)


def _landmarks(everything: Sequence[LandmarkEstimates], run: Replay) -> Series:
    rows = []
    for tracks in everything:
        std = np.sqrt(np.trace(tracks.covariances, axis1=1, axis2=2))
        limit, enough = run.parameters.report_std, run.parameters.report_existence
        reported = (tracks.existence >= enough) & (std <= limit)
        shown = reported | (
            (tracks.existence >= CANDIDATE_EXISTENCE) & (std <= CANDIDATE_STD * limit)
        )
        table = {
            "id": tracks.ids,
            "type": tracks.types,
            "x": tracks.positions[:, 0],
            "y": tracks.positions[:, 1],
            "z": tracks.positions[:, 2],
            "pxx": tracks.covariances[:, 0, 0],
            "pxy": tracks.covariances[:, 0, 1],
            "pyy": tracks.covariances[:, 1, 1],
            "sigma": std,
            "existence": tracks.existence,
            "reported": reported,
        }
        rows.append({name: values[shown].astype(np.float64) for name, values in table.items()})
    return _ragged("landmark", rows)


def _paths(output: FilterOutput, tracks: LandmarkEstimates, stub: float) -> Series:
    """The paths of one step, as the likeliest association has them."""
    given, weight = _association(output)
    values = output.measurements.values
    sources, landmarks = _sources(output, tracks, given)
    over = _over(output, tracks, landmarks)
    lost = np.isnan(over).any(axis=1)
    over[lost] = _stubs(output, values[lost], stub)
    measured = {name: values[:, column] for column, name in enumerate(COMPONENTS)}
    return {
        "source": sources.astype(np.float64),
        "id": landmarks.astype(np.float64),
        "weight": weight,
        "x": over[:, 0],
        "y": over[:, 1],
        "length": measured["path_length"],
        "azimuth": np.degrees(measured["aoa_azimuth"]),
        "doppler": measured["doppler"],
    }


def _association(output: FilterOutput) -> tuple[IntArray, FloatArray]:
    """(J,) landmark of each path in the likeliest association, and the probability of that."""
    found = output.associations
    if not len(found.ids):
        count = len(output.measurements)
        return np.full(count, NONE), np.zeros(count)
    best = found.ids[int(np.argmax(found.weight))]
    return best, found.weight @ (found.ids == best)


def _sources(
    output: FilterOutput, tracks: LandmarkEstimates, given: IntArray
) -> tuple[IntArray, IntArray]:
    """(J,) Source of each path, and the id of its landmark; a birth that is believed has one."""
    row = {int(number): index for index, number in enumerate(tracks.ids)}
    sources = np.full(len(given), int(Source.CLUTTER))
    landmarks = given.copy()
    for path, number in enumerate(given.tolist()):
        born = int(output.associations.born[path])
        if number == 0:
            sources[path] = Source.LOS
        elif number in row:
            sources[path] = _SOURCE_OF_TYPE[int(tracks.types[row[number]])]
        elif born in row and tracks.existence[row[born]] >= output.parameters.report_existence:
            sources[path], landmarks[path] = Source.NEW, born
    return sources, landmarks


def _over(output: FilterOutput, tracks: LandmarkEstimates, landmarks: IntArray) -> FloatArray:
    """(J, 2) where each path met its landmark; NaN where it has none, or meets none."""
    bs = output.parameters.bs
    row = {0: 0, **{int(number): index for index, number in enumerate(tracks.ids, start=1)}}
    points = incidence_points(
        output.state.ue_mean,
        np.vstack([bs, tracks.positions]),
        np.concatenate([[int(LandmarkType.BS)], tracks.types]),
        bs,
        output.parameters.ue_height,
    )
    nowhere = np.full(2, np.nan)
    found = [points[row[number], :2] if number in row else nowhere for number in landmarks.tolist()]
    return np.array(found).reshape(-1, 2)


def _stubs(output: FilterOutput, values: FloatArray, length: float) -> FloatArray:
    """(n, 2) a short way in the direction from which a path came."""
    state = output.state.ue_mean
    angle = state[2] + values[:, COMPONENTS.index("aoa_azimuth")]
    return state[:2] + length * np.column_stack([np.cos(angle), np.sin(angle)])


def _ragged(name: str, steps: Sequence[Series]) -> Series:
    """Tables of different lengths one after the other."""
    if not steps:
        return {f"{name}_start": np.zeros(1)}
    counts = [len(next(iter(step.values()))) for step in steps]
    together = {f"{name}_{key}": np.concatenate([s[key] for s in steps]) for key in steps[0]}
    return {f"{name}_start": np.concatenate([[0], np.cumsum(counts)]).astype(float), **together}
