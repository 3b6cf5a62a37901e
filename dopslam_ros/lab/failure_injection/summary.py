"""What trials come to: how often and how soon a vehicle is found, and how well."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from dopslam_ros.lab.failure_injection.trial import Trial

# A recovery counts when it took no more sets than this.
IN_TIME = 10


def summarise_trials(trials: Sequence[Trial]) -> dict[str, Any]:
    """What the trials of a kind come to, by the names of the JSON output.

    Errors and NEES are over all sets from the recovery to the end, of the runs that recovered.
    """
    recovered = np.array([one.recovered for one in trials])
    noticed = np.array([one.noticed for one in trials])
    in_time = (recovered > 0) & (recovered <= IN_TIME)
    error = np.concatenate([one.error for one in trials])
    covariance = np.concatenate([one.covariance for one in trials])
    seconds = np.concatenate([one.seconds for one in trials])
    some = len(error) > 0
    variance = covariance[:, 0, 0] + covariance[:, 1, 1]
    return {
        "runs": len(trials),
        "recovered_in_time": float(np.mean(in_time)),
        "sets_median": float(np.median(recovered[in_time])) if in_time.any() else math.nan,
        "sets_most": int(recovered.max()),
        "noticed": float(np.mean(noticed > 0)),
        "noticed_after_median": float(np.median(noticed[noticed > 0])) if noticed.any() else 0.0,
        "position_rmse": float(np.sqrt(np.square(error[:, :2]).sum(1).mean())) if some else None,
        "position_std": float(np.sqrt(variance.mean())) if some else None,
        "nees_mean": float(np.mean(np.concatenate([t.nees for t in trials]))) if some else None,
        "lost_ms_max": float(1e3 * seconds.max()) if len(seconds) else None,
    }


def trials_table(rows: dict[str, dict[str, Any]]) -> list[str]:
    """The summaries by kind, as lines to print."""
    heads = ("in time", "noticed", "sets", "most", "RMSE [m]", "std [m]", "NEES")
    lines = [f"{'':12}" + "".join(f"{head:>10}" for head in heads)]
    for kind, row in rows.items():
        cells = [
            f"{row['recovered_in_time']:.1%}",
            f"{row['noticed']:.1%}",
            f"{row['sets_median']:g}",
            f"{row['sets_most']}",
            *(
                "-" if row[key] is None else f"{row[key]:.3f}"
                for key in ("position_rmse", "position_std", "nees_mean")
            ),
        ]
        lines.append(f"{kind:12}" + "".join(f"{cell:>10}" for cell in cells))
    lines.append(f"in time: within {IN_TIME} sets; NEES is 4 where the covariance is honest")
    return lines
