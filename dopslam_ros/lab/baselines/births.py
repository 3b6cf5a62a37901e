"""New landmarks from single paths, for the filters that are written in NumPy."""

from __future__ import annotations

from dopslam_ros.core.linalg.jit import from_python
from dopslam_ros.core.pmb import birth
from dopslam_ros.core.pmb.birth import Births
from dopslam_ros.core.pmb.density import Density
from dopslam_ros.core.pmb.likelihood import Observed
from dopslam_ros.core.settings.filtering import FilterParameters

_propose = from_python(birth.propose)


def propose(
    density: Density, observed: Observed, speed: float, parameters: FilterParameters
) -> Births:
    """``core.pmb.birth.propose``, which says what it does, for the vehicle of a density."""
    return _propose(density, observed, float(speed), parameters.constants)
