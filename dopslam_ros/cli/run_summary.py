"""What a replayed run comes to, for the terminal."""

from __future__ import annotations

from statistics import fmean
from typing import Any


def print_summary(summary: dict[str, Any]) -> None:
    """A small table; what is not known is not shown."""
    rows = (
        ("position [m]", "position_rmse", "bound_position_rms"),
        ("heading [deg]", "heading_rmse_deg", "bound_heading_rms_deg"),
        ("clock bias [m]", "clock_bias_rmse", "bound_clock_rms"),
    )
    if any(key in summary for _, key, _ in rows):
        print(f"{'':18}{'RMSE':>10}{'bound':>10}{'ratio':>8}")
    for label, ours, bound in rows:
        if ours in summary:
            line = f"{label:18}{summary[ours]:10.4f}"
            if bound in summary:
                line += f"{summary[bound]:10.4f}{summary[ours] / summary[bound]:8.2f}"
            print(line)
    for label, key in (("GOSPA of VAs [m]", "gospa_va"), ("GOSPA of SPs [m]", "gospa_sp")):
        if key in summary:
            last = fmean(summary[key][-10:])
            print(f"{label:18}{last:10.2f}   mean of the last {len(summary[key][-10:])} steps")
    if "nees_mean" in summary:
        print(f"{'NEES':18}{summary['nees_mean']:10.2f}   4 where the covariance is honest")
    if "step_ms_p50" in summary:
        print(
            f"{'step time [ms]':18}{summary['step_ms_p50']:10.2f}   median of {summary['steps']}"
            f" steps; 99 %: {summary['step_ms_p99']:.2f}"
        )
    for name, count in summary.get("problems", {}).items():
        print(f"problem: {name}: {count}")
    if "damage" in summary:
        print(f"damaged bag: {summary['damage']}")
