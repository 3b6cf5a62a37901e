"""Settings of the filter, and what of them the compiled functions take."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache, cached_property
from typing import NamedTuple

import numpy as np

from dopslam_ros.core.linalg.arrays import (
    BoolArray,
    FloatArray,
)
from dopslam_ros.core.linalg.quantiles import chi_square
from dopslam_ros.core.settings.layout import DIM
from dopslam_ros.core.settings.model import OnlineParameters
from dopslam_ros.core.settings.parameters import parameter


class Constants(NamedTuple):
    """What stays the same from step to step; ``FilterParameters`` says what each of them is.

    Attributes:
        bs: (3,) [m].
        ue_height: [m].
        detection_probability: p_D of what is visible.
        sp_field_of_view: field of view for SPs [m].
        noise: (6, 6) R of paths that have none of their own.
        used_components: (6,) components that count.
        log_clutter_mean: ln of the mean number of clutter paths.
        clutter_log_spans: (6,) ln of the sides of the box in which clutter is uniform.
        gates: (7,) squared distances inside which a path lies, by its number of components.
        landmark_height_mean: of new landmarks [m].
        landmark_height_std: [m].
        log_undetected_intensity: ln of the intensity of landmarks never detected, at first.
        undetected_floor: share of it that always remains.
        gamma: number of associations.
        prune_existence: landmarks less likely are dropped.
        prune_type: types less likely are dropped.
        joint: whether correlations are kept between steps.
    """

    bs: FloatArray
    ue_height: float
    detection_probability: float
    sp_field_of_view: float
    noise: FloatArray
    used_components: BoolArray
    log_clutter_mean: float
    clutter_log_spans: FloatArray
    gates: FloatArray
    landmark_height_mean: float
    landmark_height_std: float
    log_undetected_intensity: float
    undetected_floor: float
    gamma: int
    prune_existence: float
    prune_type: float
    joint: bool


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
            detection_probability=float(self.detection_probability),
            sp_field_of_view=float(self.sp_field_of_view),
            noise=self.noise,
            used_components=self.used_components,
            log_clutter_mean=math.log(self.clutter_mean) if self.clutter_mean > 0.0 else -math.inf,
            clutter_log_spans=self.clutter_log_spans,
            gates=gates(self.gate_probability),
            landmark_height_mean=float(self.landmark_height_mean),
            landmark_height_std=float(self.landmark_height_std),
            log_undetected_intensity=math.log(self.undetected_intensity),
            undetected_floor=float(self.undetected_floor),
            gamma=int(self.gamma),
            prune_existence=float(self.prune_existence),
            prune_type=float(self.prune_type),
            joint=self.coupling == "joint",
        )


@cache
def gates(probability: float) -> FloatArray:
    """(7,) squared Mahalanobis distances inside which a path lies, by its number of components."""
    return chi_square(probability, np.arange(DIM + 1))
