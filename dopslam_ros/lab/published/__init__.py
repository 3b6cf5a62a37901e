"""The numbers that the paper published, to stand beside ours."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np

from dopslam_ros.core.linalg.arrays import FloatArray
from dopslam_ros.offline.metrics import Rmse

Kind: TypeAlias = Literal["va", "sp"]


class PublishedBounds(NamedTuple):
    """Bounds at the last step: PEB [m], HEB [deg], CEB [m], mean LEB [m]."""

    peb: float
    heb: float
    ceb: float
    leb: float


@dataclass(frozen=True)
class Published:
    """Numbers read from the plots of Ge et al., with their units, as in ge2022.json.

    Wherever a Doppler noise is asked for, it is in m/s, and None stands for without Doppler; the
    answer is None where the paper has no number.
    """

    content: dict[str, Any]

    @property
    def sigmas(self) -> tuple[float, ...]:
        """Doppler noises [m/s] of the figure of the bounds."""
        return tuple(self.content["fig_bounds"]["sigma_d_mps"])

    @property
    def filter_sigma(self) -> float:
        """The Doppler noise [m/s] that the filter was run with."""
        return float(self.content["setup"]["sigma_d_mps"])

    def bounds_at(self, sigma_d: float | None) -> PublishedBounds | None:
        """The bounds at the last step."""
        figure = self.content["fig_bounds"]
        names = ("PEB", "HEB", "CEB", "LEB")
        if sigma_d is None:
            return PublishedBounds(*(float(figure["without_doppler"][name]) for name in names))
        if sigma_d not in self.sigmas:
            return None
        place = self.sigmas.index(sigma_d)
        return PublishedBounds(*(float(figure["with_doppler"][name][place]) for name in names))

    def gospa_at(self, kind: Kind, sigma_d: float | None) -> FloatArray | None:
        """(40,) mean GOSPA distance [m] of the VAs or of the SPs after each step."""
        case = self._case(sigma_d)
        return None if case is None else np.array(self.content[f"fig_gospa_{kind}_m"][case])

    def rmse_at(self, sigma_d: float | None) -> Rmse | None:
        """RMSE of the vehicle over all steps and runs."""
        case = self._case(sigma_d)
        if case is None:
            return None
        bars = self.content["fig_rmse"][case]
        names = ("position_m", "heading_deg", "clock_bias_m")
        return Rmse(*(float(bars[name]) for name in names))

    def correct_weight_at(self, sigma_d: float | None) -> float | None:
        """Mean weight of the correct association."""
        case = self._case(sigma_d)
        return None if case is None else float(self.content["correct_association_weight"][case])

    def _case(self, sigma_d: float | None) -> str | None:
        """The filter's results are for one noise only, and for without Doppler."""
        names = {self.filter_sigma: "with_doppler", None: "without_doppler"}
        return names.get(sigma_d)


@cache
def published() -> Published:
    """The paper's numbers."""
    file = resources.files("dopslam_ros.lab.published") / "ge2022.json"
    return Published(json.loads(file.read_text("utf-8")))
