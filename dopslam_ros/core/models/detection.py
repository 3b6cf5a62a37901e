"""Which landmarks can be detected from where, and how dense clutter is."""

from __future__ import annotations

import math

import numpy as np

from dopslam_ros.core.linalg.arrays import (
    BoolArray,
    FloatArray,
    IntArray,
    check_shapes,
    floats,
    integers,
)
from dopslam_ros.core.linalg.jit import from_python, jit
from dopslam_ros.core.linalg.vec import distance_between, vec
from dopslam_ros.core.settings.layout import SP, SPACE
from dopslam_ros.core.settings.model import ModelParameters

# A distance that is better known than this [m] is as good as exact.
SMALLEST_STD = 1e-9


@jit
def detection_probability(
    kind: int,
    distance: float,
    distance_std: float,
    detection_probability: float,
    sp_field_of_view: float,
) -> float:
    """p_D of one landmark: SPs fade at the edge of the field of view, others are always in it.

    Vehicle and SP are uncertain in the filter, so that p_D is the expectation over the distance,
    p_D Phi((field of view - distance) / std), not a step at the mean.

    Args:
        kind: LandmarkType.
        distance: from the vehicle [m].
        distance_std: its standard deviation [m]; 0 where it is exact.
        detection_probability: p_D of a visible landmark.
        sp_field_of_view: distance up to which SPs are visible [m].
    """
    if kind != SP:
        return detection_probability
    if distance_std <= SMALLEST_STD:
        return detection_probability if distance <= sp_field_of_view else 0.0
    beyond = (distance - sp_field_of_view) / (distance_std * math.sqrt(2.0))
    return detection_probability * 0.5 * math.erfc(beyond)


def detection_probabilities(
    model: ModelParameters,
    ue: FloatArray,
    positions: FloatArray,
    types: IntArray,
    distance_std: FloatArray | None = None,
) -> FloatArray:
    """p_D of each landmark, see ``detection_probability``.

    Args:
        model: p_D and the field of view.
        ue: (3,) position of the vehicle [m].
        positions: (M, 3) [m].
        types: (M,) LandmarkType.
        distance_std: (M,) standard deviation of the distance [m]; None when positions are exact.

    Returns:
        (M,) probabilities.

    Raises:
        ValueError: the shapes do not fit together.
    """
    count = len(types)
    std = np.zeros(count) if distance_std is None else distance_std
    check_shapes(
        ue=(ue, (SPACE,)), positions=(positions, (count, SPACE)), distance_std=(std, (count,))
    )
    return detect_all(
        floats(ue),
        floats(positions),
        integers(types),
        floats(std),
        float(model.detection_probability),
        float(model.sp_field_of_view),
    )


@from_python
def detect_all(
    ue: FloatArray,
    positions: FloatArray,
    types: IntArray,
    distance_std: FloatArray,
    p_d: float,
    sp_field_of_view: float,
) -> FloatArray:
    """``detection_probabilities`` where all is of the kind that is compiled."""
    detection, vehicle = np.empty(len(types)), vec(ue)
    for m in range(len(types)):
        distance = distance_between(vehicle, vec(positions[m]))
        detection[m] = detection_probability(
            types[m], distance, distance_std[m], p_d, sp_field_of_view
        )
    return detection


def log_clutter_intensity(model: ModelParameters, measured: BoolArray) -> FloatArray:
    """ln c(z): clutter_mean over the volume of the components that were measured.

    Constant also outside the box, where a path would otherwise be a landmark for certain.

    Args:
        model: clutter mean and box.
        measured: (J, 6) which components each path has.

    Returns:
        (J,); -inf without clutter.
    """
    log_mean = math.log(model.clutter_mean) if model.clutter_mean > 0.0 else -math.inf
    return np.asarray(log_mean - measured @ model.clutter_log_spans)
