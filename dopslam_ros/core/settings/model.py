"""The models everything shares: vehicle, sensor, noise, visibility and clutter."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar

import numpy as np

from dopslam_ros.core.linalg.arrays import (
    BoolArray,
    FloatArray,
)
from dopslam_ros.core.settings.layout import DIM, DOPPLER, PATH, VEHICLE, listed, units
from dopslam_ros.core.settings.parameters import parameter


@dataclass(frozen=True)
class ModelParameters:
    """What simulator, filter and bounds must agree on. Defaults: the paper's Section V-A."""

    bs_position: tuple[float, ...] = parameter(
        (0.0, 0.0, 40.0), "Position of the base station in the map frame.", unit="m", size=3
    )
    ue_height: float = parameter(0.0, "Height of the vehicle's antenna.", unit="m")
    initial_state: tuple[float, ...] = parameter(
        (70.7285, 0.0, math.pi / 2.0, 300.0),
        f"Mean of the vehicle's state at the first snapshot: {listed(VEHICLE)}.",
        unit=units(VEHICLE),
        size=len(VEHICLE),
    )
    initial_std: tuple[float, ...] = parameter(
        (0.3, 0.3, math.radians(0.3), 0.3),
        "Its standard deviations.",
        unit=units(VEHICLE),
        size=len(VEHICLE),
        low=1e-9,
    )
    process_noise_std: tuple[float, ...] = parameter(
        (0.2, 0.2, 0.001, 0.2),
        "Standard deviations of the process noise gathered over one process_noise_period.",
        unit=units(VEHICLE),
        size=len(VEHICLE),
        low=0.0,
    )
    process_noise_period: float = parameter(
        0.5, "Time over which process_noise_std is gathered.", unit="s", low=1e-6
    )
    measurement_noise_std: tuple[float, ...] = parameter(
        (0.1, 0.05, 0.05, 0.05, 0.05, 0.1),
        "Standard deviations of path length [m], azimuth and elevation of arrival, azimuth and"
        " elevation of departure [rad], Doppler [m/s]; NaN for a component that is not measured"
        " or not to be used.",
        unit=units(PATH),
        size=DIM,
        low=1e-9,
        nan=True,
    )
    detection_probability: float = parameter(
        0.9, "Probability that a visible landmark is detected, p_D.", low=0.0, high=1.0
    )
    sp_field_of_view: float = parameter(
        50.0, "Distance up to which scattering points are visible.", unit="m", low=0.0
    )
    clutter_mean: float = parameter(
        1.0, "Mean number of clutter paths in a snapshot.", low=0.0, high=1e4
    )
    clutter_path_length: tuple[float, ...] = parameter(
        (300.0, 700.0),
        "Interval over which the path lengths of clutter are uniform.",
        unit="m",
        size=2,
        increasing=True,
    )
    clutter_doppler: tuple[float, ...] = parameter(
        (-25.0, 25.0),
        "Interval over which the Doppler of clutter is uniform.",
        unit="m/s",
        size=2,
        increasing=True,
    )

    @cached_property
    def bs(self) -> FloatArray:
        """(3,) position of the base station [m]."""
        return np.array(self.bs_position)

    @cached_property
    def noise(self) -> FloatArray:
        """(6, 6) measurement covariance R; NaN on the diagonal where nothing is measured."""
        return np.diag(np.square(self.measurement_noise_std))

    @cached_property
    def used_components(self) -> BoolArray:
        """(6,) which components are measured and used."""
        return np.isfinite(self.measurement_noise_std)

    @cached_property
    def clutter_log_spans(self) -> FloatArray:
        """(6,) ln of the sides of the box in which clutter is uniform."""
        box = clutter_box(self)
        return np.asarray(np.log(box[:, 1] - box[:, 0]))

    @cached_property
    def noise_rate(self) -> FloatArray:
        """(U,) variance that the process noise adds per second."""
        return np.square(self.process_noise_std) / self.process_noise_period

    @cached_property
    def initial_covariance(self) -> FloatArray:
        """(U, U) covariance of the initial state."""
        return np.diag(np.square(self.initial_std))


@dataclass(frozen=True)
class OnlineParameters(ModelParameters):
    """What everything that runs along with the vehicle needs beside the models."""

    control_wait: float = parameter(
        1.0,
        "How far newer snapshots may be ahead, and how long nothing may arrive, before one is"
        " processed without the control it waits for.",
        unit="s",
        low=1e-3,
        high=3600.0,
    )
    reorder_window: float = parameter(
        0.0,
        "How much later than a newer one a set or control may come and still be sorted in. Every"
        " result waits that much longer.",
        unit="s",
        low=0.0,
        high=1.0,
    )
    control_timeout: float = parameter(
        0.6,
        "How long a control holds. It is used on after that, with noise that grows as the two"
        " parameters below say.",
        unit="s",
        low=0.0,
        high=3600.0,
    )
    coasting_acceleration: float = parameter(
        3.0,
        "Standard deviation of the vehicle's acceleration while its controls are missing.",
        unit="m/s^2",
        low=0.0,
        high=100.0,
    )
    coasting_turn_acceleration: float = parameter(
        0.3,
        "Standard deviation of the vehicle's angular acceleration while its controls are missing.",
        unit="rad/s^2",
        low=0.0,
        high=100.0,
    )


M = TypeVar("M", bound=ModelParameters)


def with_doppler_std(model: M, sigma_d: float | None) -> M:
    """The same model with another Doppler noise [m/s], or without Doppler (None)."""
    stds = list(model.measurement_noise_std)
    stds[DOPPLER] = math.nan if sigma_d is None else sigma_d
    return replace(model, measurement_noise_std=tuple(stds))


def clutter_box(model: ModelParameters) -> FloatArray:
    """(6, 2) the box in which clutter is uniform: its lower and upper corner."""
    full, half = (-math.pi, math.pi), (-math.pi / 2.0, math.pi / 2.0)
    return np.array([model.clutter_path_length, full, half, full, half, model.clutter_doppler])
