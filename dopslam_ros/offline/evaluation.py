"""Runs judged against the truth: a record for each step, a summary for the run."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dopslam_ros.core.linalg.arrays import FloatArray
from dopslam_ros.core.pcrb.bounds import Bounds
from dopslam_ros.core.pmb import LandmarkEstimates
from dopslam_ros.core.settings.layout import LandmarkType
from dopslam_ros.offline.metrics import Gospa, gospa, nees, rmse, state_errors


@dataclass(frozen=True)
class StepRecord:
    """One step judged; what cannot be judged is NaN.

    Attributes:
        error: (U,) estimate minus truth.
        nees: of the vehicle.
        va: GOSPA of the VAs, with its parts.
        sp: of the SPs.
        bound: (3,) PEB [m], HEB [rad], CEB [m].
        seconds: time the step took.
    """

    error: FloatArray
    nees: float
    va: Gospa
    sp: Gospa
    bound: FloatArray
    seconds: float

    @property
    def gospa_va(self) -> float:
        """GOSPA distance of the VAs [m]."""
        return self.va.distance

    @property
    def gospa_sp(self) -> float:
        """GOSPA distance of the SPs [m]."""
        return self.sp.distance


NOT_JUDGED = Gospa(math.nan, math.nan, math.nan, math.nan)


def judge_step(
    mean: FloatArray,
    covariance: FloatArray,
    landmarks: LandmarkEstimates,
    true_state: FloatArray | None,
    true_vas: FloatArray | None,
    true_sps: FloatArray | None,
    bound: Bounds | None,
    seconds: float = math.nan,
) -> StepRecord:
    """Compares an estimate with the truth as far as it is known.

    Args:
        mean: (U,) estimate of the vehicle.
        covariance: (U, U).
        landmarks: the map reported.
        true_state: (U,) or None.
        true_vas: (n, 3) or None.
        true_sps: (n, 3) or None.
        bound: at this step, or None.
        seconds: time the step took.
    """
    error, normalised = np.full(len(mean), np.nan), math.nan
    if true_state is not None:
        error = state_errors(mean, true_state)
        normalised = nees(error, covariance)

    def judged_map(truth: FloatArray | None, kind: LandmarkType) -> Gospa:
        if truth is None:
            return NOT_JUDGED
        return gospa(truth, landmarks.positions[landmarks.types == kind])

    return StepRecord(
        error=error,
        nees=normalised,
        va=judged_map(true_vas, LandmarkType.VA),
        sp=judged_map(true_sps, LandmarkType.SP),
        bound=np.full(3, np.nan) if bound is None else np.array(bound[:3]),
        seconds=seconds,
    )


def summarise(run: Sequence[StepRecord]) -> dict[str, Any]:
    """Averages over the steps of a run, by the names of the JSON output.

    What is not known in any step is left out.
    """

    def column(name: str) -> FloatArray:
        return np.array([getattr(step, name) for step in run], dtype=np.float64)

    summary: dict[str, Any] = {"steps": len(run)}
    if not run:
        return summary
    seconds = column("seconds") * 1e3
    if np.isfinite(seconds).any():
        summary["step_ms_p50"] = float(np.nanpercentile(seconds, 50))
        summary["step_ms_p99"] = float(np.nanpercentile(seconds, 99))
    judged = np.isfinite(column("error")).all(axis=1)
    if judged.any():
        errors = rmse(column("error")[judged])
        summary["position_rmse"] = errors.position
        summary["heading_rmse_deg"] = errors.heading_deg
        summary["clock_bias_rmse"] = errors.clock_bias
        summary["nees_mean"] = float(np.nanmean(column("nees")))
    for name in ("gospa_va", "gospa_sp"):
        distances = column(name)
        if np.isfinite(distances).all():
            summary[name] = distances.tolist()
    bound = np.square(column("bound"))
    known = np.isfinite(bound).all(axis=1)
    if known.any():
        peb, heb, ceb = np.sqrt(bound[known].mean(axis=0))
        summary["bound_position_rms"] = float(peb)
        summary["bound_heading_rms_deg"] = math.degrees(heb)
        summary["bound_clock_rms"] = float(ceb)
    return summary
