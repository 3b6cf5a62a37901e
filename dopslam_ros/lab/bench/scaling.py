"""How the step's time grows with the map and with what is in view of the vehicle."""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np
from scipy.linalg import block_diag

from dopslam_ros.core.linalg.arrays import FloatArray, IntArray
from dopslam_ros.core.models.motion import Control
from dopslam_ros.core.pmb import (
    Density,
    FilterParameters,
    Posterior,
    initial_density,
    reported_landmarks,
)
from dopslam_ros.core.pmb.coordinates import frames, local_coordinates
from dopslam_ros.core.pmb.inactive import deactivate
from dopslam_ros.core.pmb.inactive_grid import InactiveGrid
from dopslam_ros.core.pmb.posterior import posterior_of
from dopslam_ros.core.settings.layout import SPACE, LandmarkType
from dopslam_ros.lab.bench.records import Measured, Ratio, milliseconds, times_as_long
from dopslam_ros.lab.bench.steps import Task, filter_step, inputs_of, step_seconds
from dopslam_ros.simulation.matched import filter_parameters_for
from dopslam_ros.simulation.scenario import Scenario
from dopslam_ros.system.stopping import until_stopped

MAP_SIZES = (10, 1_000, 10_000)
VIEW_SIZES = (10, 20, 50, 100)
# The walls of the street, as virtual anchors [m]; they count as landmarks in view.
WALLS = np.array(
    [[60.0, 190.0, 40.0], [-60.0, 190.0, 40.0], [60.0, -190.0, 40.0], [-60.0, -190.0, 40.0]]
)
# Each coordinate of a landmark in the map is known this well, of its own, [m].
KNOWN_STD = 0.3
# Landmarks put into the map at a time: the covariance of all at once would not fit anywhere.
CHUNK = 100


def map_growth(quick: bool) -> Measured:
    """10 landmarks in view; the rest of the map is far down the street."""
    sizes = (10, 100, 1_000) if quick else MAP_SIZES
    worlds = [_World(10, size, 20 if quick else 200) for size in sizes]
    figures = [
        milliseconds(f"step, {size:,} landmarks", seconds)
        for size, seconds in zip(sizes, _seconds(worlds), strict=True)
    ]
    reports = [
        milliseconds(f"map of {size:,} worked out", world.report_seconds(3 if quick else 20))
        for size, world in zip(sizes, worlds, strict=True)
    ]
    ratios = [times_as_long(one, figures[0]) for one in figures[1:]]
    return Measured((*figures, *reports), tuple(ratios))


def view_growth(quick: bool) -> Measured:
    """The whole map in view, and as many paths as landmarks in every set."""
    sizes = (10, 20) if quick else VIEW_SIZES
    worlds = [_World(size, size, 10 if quick else 60) for size in sizes]
    figures = [
        milliseconds(f"step, {size} in view", seconds)
        for size, seconds in zip(sizes, _seconds(worlds), strict=True)
    ]
    exponent = growth_exponent(sizes, [one.median for one in figures])
    ratios = (
        times_as_long(figures[-1], figures[0]),
        Ratio(f"exponent of growth, {sizes[0]} to {sizes[-1]}", exponent),
    )
    return Measured(tuple(figures), ratios)


class _World:
    """A street, its map in the filter, and a run.

    Args:
        in_view: landmarks in view.
        size: landmarks in the map.
        steps: of the run.
    """

    def __init__(self, in_view: int, size: int, steps: int) -> None:
        scenario = street(in_view, size - in_view, steps)
        self._parameters = filter_parameters_for(scenario)
        self._state = with_map(self._parameters, scenario.landmarks, scenario.landmark_types)
        self.task = Task(filter_step(self._parameters), self._state, inputs_of(scenario, 1))

    def report_seconds(self, count: int) -> list[float]:
        """Times to find where every landmark is, as when somebody asks for the map [s]."""
        seconds = []
        for _ in until_stopped(range(count)):
            started = time.perf_counter()
            reported_landmarks(self._state, self._parameters)
            seconds.append(time.perf_counter() - started)
        return seconds


def _seconds(worlds: Sequence[_World]) -> list[list[float]]:
    """The steps of each; the first few, in which things settle, do not count."""
    found = step_seconds(*(world.task for world in worlds))
    return [seconds[len(seconds) // 5 :] for seconds in found]


def growth_exponent(sizes: Sequence[float], values: Sequence[float]) -> float:
    """p of values ~ sizes^p, by least squares over the logarithms."""
    return float(np.polyfit(np.log(sizes), np.log(values), 1)[0])


def street(in_view: int, far: int, steps: int) -> Scenario:
    """A vehicle that creeps along a street; landmarks around it and more far down both ends.

    Args:
        in_view: landmarks in view, the walls among them.
        far: scattering points beyond every field of view.
        steps: of the run.
    """
    start = np.array([-5.0, 10.0, 0.0])
    number = np.arange(in_view - len(WALLS))
    # Evenly over a ring around the vehicle, as the seeds of a sunflower.
    radius = np.sqrt(15.0**2 + (42.0**2 - 15.0**2) * (number + 0.5) / max(len(number), 1))
    bearing = number * np.pi * (3.0 - np.sqrt(5.0))
    near = start + np.stack(
        [radius * np.cos(bearing), radius * np.sin(bearing), 4.0 + number % 7], 1
    )
    number = np.arange(far)
    along = np.where(number % 2 == 0, 1.0, -1.0) * (300.0 + 10.0 * (number // 2))
    away = np.stack([along, np.where(number % 4 < 2, 15.0, -15.0), 4.0 + number % 7], 1)
    types = [int(LandmarkType.VA)] * len(WALLS) + [int(LandmarkType.SP)] * (len(near) + far)
    return Scenario(
        name="street",
        period=0.1,
        initial_state=(*start[:2].tolist(), 0.0, 300.0),
        landmarks=np.concatenate([WALLS, near, away]),
        landmark_types=np.array(types, dtype=np.int64),
        controls=(Control(0.5, 0.0),) * steps,
    )


def with_map(parameters: FilterParameters, positions: FloatArray, types: IntArray) -> Posterior:
    """The density before the first snapshot with a map in it.

    The landmarks are where they are, known well on their own, and all share the error of the
    vehicle's position, so that all are correlated. Those out of view are inactive.

    Args:
        parameters: of the filter.
        positions: (L, 3) of the landmarks [m].
        types: (L,) VA or SP; the anchors first.
    """
    start = initial_density(parameters)
    distance = np.linalg.norm(positions[:, :2] - start.ue_mean[:2], axis=1)
    active = (types == LandmarkType.VA) | (distance < 2.0 * parameters.sp_field_of_view)
    near = np.flatnonzero(active)
    density = _appended(start, positions[near], types[near], near + 1)
    inactive = InactiveGrid()
    for far in np.array_split(np.flatnonzero(~active), -(-int((~active).sum()) // CHUNK) or 1):
        density = _appended(density, positions[far], types[far], far + 1)
        density, inactive = deactivate(density, inactive, parameters)
    return posterior_of(density._replace(next_id=len(types) + 1), inactive)


def _appended(density: Density, positions: FloatArray, types: IntArray, ids: IntArray) -> Density:
    """A density with more landmarks, active."""
    count, old = len(ids), len(density.mean)
    origin = np.tile(np.append(density.ue_mean[:2], 0.0), (count, 1))
    axes = frames(positions - origin)
    q = local_coordinates(origin, axes, positions)
    distance = q[:, 0]
    # By the axes of its frame a landmark moves along the range and by distance times the tangents.
    to_q = (
        np.swapaxes(axes, 1, 2) / np.stack([np.ones(count), distance, distance], axis=1)[:, :, None]
    )
    own = [KNOWN_STD**2 * one @ one.T for one in to_q]
    follows = np.zeros((SPACE * count, old))
    follows[:, :2] = to_q.reshape(-1, SPACE)[:, :2]  # x and y of the vehicle
    cross = follows @ density.covariance
    joint = block_diag(density.covariance, *own)
    joint[old:, :old], joint[:old, old:] = cross, cross.T
    joint[old:, old:] += cross @ follows.T
    tracks, none = len(density.track_id), density.component_track
    return density.but(
        mean=np.concatenate([density.mean, q.ravel()]),
        covariance=joint,
        origin=np.concatenate([density.origin, origin]),
        axes=np.concatenate([density.axes, axes]),
        component_track=np.concatenate([none, tracks + np.arange(count)]),
        component_type=np.concatenate([density.component_type, types]),
        component_weight=np.concatenate([density.component_weight, np.ones(count)]),
        track_id=np.concatenate([density.track_id, ids]),
        existence=np.concatenate([density.existence, np.full(count, 0.9999)]),
    )
