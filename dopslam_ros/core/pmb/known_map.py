"""The map without the vehicle: taken out of a density, and put into another."""

from __future__ import annotations

from dopslam_ros.core.pmb.merge import uncouple
from dopslam_ros.core.pmb.state import FilterState
from dopslam_ros.core.settings.filtering import FilterParameters
from dopslam_ros.core.settings.layout import UE


def map_of(state: FilterState) -> FilterState:
    """The same map with no vehicle: its mean, covariance and correlation with the map are zero."""
    mean, covariance = state.mean.copy(), state.covariance.copy()
    mean[:UE] = 0.0
    covariance[:UE] = covariance[:, :UE] = 0.0
    return state.but(mean=mean, covariance=covariance)


def with_map(state: FilterState, known: FilterState, parameters: FilterParameters) -> FilterState:
    """The vehicle of one density in the map of another, which it is independent of.

    Args:
        state: whose vehicle is taken.
        known: whose map is taken, with the correlations inside it.
        parameters: with ``coupling: marginal`` those are dropped too.
    """
    bare = map_of(known)
    bare.mean[:UE] = state.ue_mean
    bare.covariance[:UE, :UE] = state.ue_covariance
    if parameters.coupling == "marginal":
        uncouple(bare.covariance)
    return bare
