"""The paths of a set as the filters take them."""

from __future__ import annotations

from dopslam_ros.core.linalg.arrays import floats
from dopslam_ros.core.models.measurements import MeasurementSet
from dopslam_ros.core.pmb import likelihood as kernels
from dopslam_ros.core.pmb.likelihood import Observed
from dopslam_ros.core.settings.filtering import FilterParameters


def prepare(measurements: MeasurementSet, parameters: FilterParameters) -> Observed:
    """Fills in the parameter's covariance where a path has none and masks what is not used."""
    return kernels.prepare(
        floats(measurements.values),
        floats(measurements.covariances),
        parameters.used_components,
        parameters.noise,
    )
