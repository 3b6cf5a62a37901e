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
from dopslam_ros.core.models import detection_kernels as kernels
from dopslam_ros.core.settings.model import ModelParameters


def detection_probabilities(
    model: ModelParameters,
    ue: FloatArray,
    positions: FloatArray,
    types: IntArray,
    spread: FloatArray | None = None,
) -> FloatArray:
    """p_D of each landmark: SPs fade at the edge of the field of view, BS and VAs are always in it.

    Vehicle and SP are uncertain in the filter, so its p_D is the expectation over the distance,
    p_D * Phi((field of view - distance) / spread), not a step at the mean.

    Args:
        model: p_D and the field of view.
        ue: (3,) position of the vehicle [m].
        positions: (M, 3) [m].
        types: (M,) LandmarkType.
        spread: (M,) standard deviation of the distance [m]; None when positions are exact.

    Returns:
        (M,) probabilities.
    """
    detection = np.empty(len(types))
    spread = np.zeros_like(detection) if spread is None else spread
    check_shapes(
        ue=(ue, (3,)), positions=(positions, (len(types), 3)), spread=(spread, detection.shape)
    )
    kernels.detection_probabilities(
        floats(ue),
        floats(positions),
        integers(types),
        floats(spread),
        float(model.detection_probability),
        float(model.sp_field_of_view),
        detection,
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
