"""The numbers that the paper published, to stand beside ours."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Any


@dataclass(frozen=True)
class Published:
    """Numbers read from the plots of Ge et al., with their units, as in ge2022.json."""

    content: dict[str, Any]

    def bounds_at(self, sigma_d: float | None) -> tuple[float, float, float, float] | None:
        """PEB [m], HEB [deg], CEB [m], mean LEB [m]; None where the paper has no number.

        Args:
            sigma_d: Doppler noise [m/s], or None for without Doppler.
        """
        figure = self.content["fig_bounds"]
        names = ("PEB", "HEB", "CEB", "LEB")
        if sigma_d is None:
            peb, heb, ceb, leb = (float(figure["without_doppler"][name]) for name in names)
            return peb, heb, ceb, leb
        if sigma_d not in figure["sigma_d_mps"]:
            return None
        place = figure["sigma_d_mps"].index(sigma_d)
        peb, heb, ceb, leb = (float(figure["with_doppler"][name][place]) for name in names)
        return peb, heb, ceb, leb


@cache
def published() -> Published:
    """The paper's numbers."""
    file = resources.files("dopslam_ros.published") / "ge2022.json"
    return Published(json.loads(file.read_text("utf-8")))
