"""Settings of the bounds."""

from __future__ import annotations

from dataclasses import dataclass

from dopslam_ros.core.settings.model import (
    OnlineParameters,
)
from dopslam_ros.core.settings.parameters import parameter


@dataclass(frozen=True)
class BoundsParameters(OnlineParameters):
    """Settings of the bounds beside the models."""

    source: str = parameter(
        "auto",
        "Where the bounds are evaluated: at the truth, at the filter's estimate, or auto: at the"
        " truth when somebody publishes it.",
        choices=("auto", "truth", "estimate"),
    )
