"""The map without the vehicle: taken out of a density, and put into another."""

from __future__ import annotations

from dopslam_ros.core.pmb.density import Density
from dopslam_ros.core.pmb.merge_gaussian import uncouple
from dopslam_ros.core.settings.filtering import FilterParameters


def map_of(density: Density) -> Density:
    """The same map with no vehicle: its mean, covariance and correlation with the map are zero."""
    mean, covariance, vehicle = density.mean.copy(), density.covariance.copy(), density.start[0]
    mean[:vehicle] = 0.0
    covariance[:vehicle] = covariance[:, :vehicle] = 0.0
    return density._replace(mean=mean, covariance=covariance)


def with_map(density: Density, known: Density, parameters: FilterParameters) -> Density:
    """p(s) p(X): the vehicle of one density in the map of another, which it is independent of.

    Args:
        density: whose vehicle is taken.
        known: whose map is taken, with the correlations inside it.
        parameters: with ``coupling: marginal`` those are dropped too.
    """
    bare, vehicle = map_of(known), known.start[0]
    bare.mean[:vehicle] = density.ue_mean
    bare.covariance[:vehicle, :vehicle] = density.ue_covariance
    if parameters.coupling == "marginal":
        uncouple(bare.covariance, bare.start)
    return bare
