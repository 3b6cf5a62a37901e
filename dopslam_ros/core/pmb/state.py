"""What the filter knows and how it is set."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np

from dopslam_ros.core.linalg.arrays import BoolArray, FloatArray, IntArray, block_indices, floats, integers
from dopslam_ros.core.models.channel import DIM, LandmarkType
from dopslam_ros.core.pmb.inactive_grid import Asleep
from dopslam_ros.core.pmb.undetected import nothing_seen
from dopslam_ros.core.pmb.coordinates_kernels import components_in_space
from dopslam_ros.core.pmb.records import UE, Constants, Density, Undetected
from dopslam_ros.core.settings.model import OnlineParameters
from dopslam_ros.core.settings.parameters import parameter
from dopslam_ros.core.linalg.quantiles import chi_square

# The types that a landmark of unknown type may have; a BS is always known.
UNKNOWN_TYPES = (int(LandmarkType.VA), int(LandmarkType.SP))
__all__ = [
    "UE",
    "UNKNOWN_TYPES",
    "FilterParameters",
    "FilterState",
    "gates",
    "initial_filter_state",
]


@dataclass(frozen=True)
class FilterParameters(OnlineParameters):
    """Settings of the EK-PMB filter beside the models."""

    gamma: int = parameter(10, "Number of best data associations kept in a step.", low=1, high=1000)
    mapping: bool = parameter(
        True,
        "Whether the map is learned; false: localise only, in the map that was loaded, which stays"
        " as it is.",
    )
    coupling: str = parameter(
        "joint",
        "Whether the correlation between vehicle and map is kept from step to step (joint) or"
        " dropped as in the paper (marginal).",
        choices=("joint", "marginal"),
    )
    density: str = parameter(
        "pmb",
        "Whether the associations of a step are merged into one density at once (pmb) or carried"
        " on as global hypotheses (pmbm).",
        choices=("pmb", "pmbm"),
    )
    hypotheses_kept: int = parameter(
        10, "Number of global hypotheses carried on, with pmbm.", low=1, high=1000
    )
    prune_hypothesis: float = parameter(
        1e-3,
        "Global hypotheses less likely than this are dropped, with pmbm.",
        low=0.0,
        high=0.5,
    )
    gate_probability: float = parameter(
        0.9999,
        "Probability that a path lies inside the gate of its landmark.",
        low=0.5,
        high=1.0 - 1e-12,
    )
    undetected_intensity: float = parameter(
        1.5e-5,
        "Intensity of landmarks never detected so far, of each type, before the first snapshot.",
        unit="1/m^3",
        low=1e-15,
        high=1.0,
    )
    undetected_floor: float = parameter(
        1e-3,
        "Share of undetected_intensity that remains however often nothing was detected: walls may"
        " come into sight at any time.",
        low=1e-12,
        high=1.0,
    )
    landmark_height_mean: float = parameter(
        20.0, "Mean of the weak prior on the height of a new landmark.", unit="m"
    )
    landmark_height_std: float = parameter(
        50.0, "Standard deviation of the weak prior on the height.", unit="m", low=1e-3
    )
    prune_existence: float = parameter(
        1e-4, "Landmarks less likely to exist than this are dropped.", low=0.0, high=0.5
    )
    prune_type: float = parameter(
        1e-3, "Type hypotheses less likely than this are dropped.", low=0.0, high=0.3
    )
    report_existence: float = parameter(
        0.5,
        "Landmarks more likely to exist than this are reported in the map.",
        low=0.0,
        high=1.0,
    )
    report_std: float = parameter(
        10.0,
        "Landmarks whose position is known worse than this (root of the covariance's trace) are"
        " not reported yet.",
        unit="m",
        low=1e-3,
    )
    initial_pose: str = parameter(
        "known",
        "Whether initial_state says where the vehicle is (known), or it must be found from the"
        " first sets, by the base station and the map if there is one (unknown).",
        choices=("known", "unknown"),
    )
    health_position_std: float = parameter(
        3.0,
        "Diagnostics warn when the vehicle's position is known worse than this (root of the"
        " covariance's trace).",
        unit="m",
        low=1e-3,
    )

    @cached_property
    def constants(self) -> Constants:
        """The same as the compiled parts take it."""
        return Constants(
            bs=self.bs,
            ue_height=float(self.ue_height),
            probability=float(self.detection_probability),
            sight=float(self.sp_field_of_view),
            noise=self.noise,
            used=self.used_components,
            log_clutter=math.log(self.clutter_mean) if self.clutter_mean > 0.0 else -math.inf,
            log_spans=self.clutter_log_spans,
            gates=gates(self.gate_probability),
            height_mean=float(self.landmark_height_mean),
            height_std=float(self.landmark_height_std),
            log_undetected=math.log(self.undetected_intensity),
            floor=float(self.undetected_floor),
            gamma=int(self.gamma),
            prune_existence=float(self.prune_existence),
            prune_type=float(self.prune_type),
            joint=self.coupling == "joint",
        )


@cache
def gates(probability: float) -> FloatArray:
    """(7,) squared Mahalanobis distances inside which a path lies, by its number of components."""
    return chi_square(probability, np.arange(DIM + 1))


@dataclass(frozen=True)
class FilterState:
    """What the filter knows of vehicle and map.

    Attributes:
        density: of the vehicle and of all landmarks that may be detected from where it is.
        asleep: landmarks put aside while they are out of view.
    """

    density: Density
    asleep: Asleep

    # The parts of the density, which says what they are.

    @property
    def mean(self) -> FloatArray:
        """(4 + 3 C,)."""
        return self.density.mean

    @property
    def covariance(self) -> FloatArray:
        """(4 + 3 C, 4 + 3 C)."""
        return self.density.covariance

    @property
    def origin(self) -> FloatArray:
        """(C, 3) [m]."""
        return self.density.origin

    @property
    def axes(self) -> FloatArray:
        """(C, 3, 3)."""
        return self.density.axes

    @property
    def component_track(self) -> IntArray:
        """(C,)."""
        return self.density.component_track

    @property
    def component_type(self) -> IntArray:
        """(C,)."""
        return self.density.component_type

    @property
    def component_weight(self) -> FloatArray:
        """(C,)."""
        return self.density.component_weight

    @property
    def track_id(self) -> IntArray:
        """(T,)."""
        return self.density.track_id

    @property
    def existence(self) -> FloatArray:
        """(T,)."""
        return self.density.existence

    @property
    def undetected(self) -> Undetected:
        """Where landmarks never detected may still be."""
        return self.density.undetected

    @property
    def next_id(self) -> int:
        """The id of the next new track."""
        return self.density.next_id

    def but(self, **parts: Any) -> FilterState:
        """The same with other parts of the density."""
        ready = {name: _as_compiled(value) for name, value in parts.items()}
        return FilterState(self.density._replace(**ready), self.asleep)

    @property
    def ue_mean(self) -> FloatArray:
        """(4,) estimate of the vehicle."""
        return self.mean[:UE]

    @property
    def ue_covariance(self) -> FloatArray:
        """(4, 4) its covariance."""
        return self.covariance[:UE, :UE]

    @property
    def all_track_ids(self) -> IntArray:
        """Ids of all tracks, awake or asleep."""
        return np.concatenate([self.track_id, *(c.track_id for c in self.asleep.cells.values())])

    @property
    def placements(self) -> FloatArray:
        """(C, 3) q of the components."""
        return self.mean[UE:].reshape(-1, 3)

    @property
    def placement_covariances(self) -> FloatArray:
        """(C, 3, 3) covariances of q."""
        index = block_indices(UE, np.arange(len(self.component_track)), 3)
        return self.covariance[index[:, :, None], index[:, None, :]]

    @property
    def positions(self) -> FloatArray:
        """(C, 3) where the components are [m]."""
        return components_in_space(self.density)[0]

    def only(self, components: BoolArray, tracks: BoolArray) -> FilterState:
        """What is left of it.

        Args:
            components: (C,) which are kept.
            tracks: (T,) which are kept; they have a component that is.
        """
        blocks = block_indices(UE, np.flatnonzero(components), 3).ravel()
        index = np.concatenate([np.arange(UE), blocks])
        renumbered = np.cumsum(tracks) - 1
        return self.but(
            mean=self.mean[index],
            covariance=self.covariance[np.ix_(index, index)],
            origin=self.origin[components],
            axes=self.axes[components],
            component_track=renumbered[self.component_track[components]],
            component_type=self.component_type[components],
            component_weight=self.component_weight[components],
            track_id=self.track_id[tracks],
            existence=self.existence[tracks],
        )


def _as_compiled(value: Any) -> Any:
    """A part of a density as the compiled functions take it."""
    if not isinstance(value, np.ndarray):
        return value
    return floats(value) if value.dtype.kind == "f" else integers(value)


def initial_filter_state(parameters: FilterParameters) -> FilterState:
    """The density before the first snapshot: the prior of the vehicle and an unknown map."""
    none = np.zeros(0, dtype=np.int64)
    density = Density(
        mean=np.array(parameters.initial_state),
        covariance=floats(parameters.initial_covariance),
        origin=np.zeros((0, 3)),
        axes=np.zeros((0, 3, 3)),
        component_track=none,
        component_type=none,
        component_weight=np.zeros(0),
        track_id=none,
        existence=np.zeros(0),
        undetected=nothing_seen(),
        next_id=1,
    )
    return FilterState(density, Asleep())
