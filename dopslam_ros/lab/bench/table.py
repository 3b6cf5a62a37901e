"""The results as text for a terminal and as Markdown."""

from __future__ import annotations

from collections.abc import Sequence

from dopslam_ros.lab.bench.records import Figure, Record
from dopslam_ros.lab.bench.results import Results


def text_table(records: Sequence[Record]) -> str:
    """A table for a terminal: figures, then ratios and notes, of each benchmark."""
    lines = [f"{'':44}{'minimum':>12}{'median':>12}{'p99':>12}{'count':>9}"]
    for record in records:
        lines.append(f"{record.name}: {record.title}")
        for one in record.measured.figures:
            label = f"  {one.name} [{one.unit}]"
            lines.append(
                f"{label:44}{''.join(f'{cell:>12}' for cell in _values(one))}{one.count:9}"
            )
        for ratio in record.measured.ratios:
            lines.append(f"  {ratio.name} = {number(ratio.value)}")
        lines += [f"  ({note})" for note in record.measured.notes]
    return "\n".join(lines)


def markdown(results: Results) -> str:
    """A document of the same."""
    lines = [
        "# Benchmarks",
        "",
        "Written by `dopslam bench --markdown BENCHMARKS.md`. All figures are of one run on one"
        " machine; what is held against each other was measured in turns, so that the ratios carry"
        " over to other machines better than the times do.",
        "",
    ]
    if results.quick:
        lines += ["Measured with `--quick`: rough figures from few repetitions.", ""]
    lines += ["| machine | |", "|---|---|"]
    lines += [f"| {name.replace('_', ' ')} | {value} |" for name, value in results.machine.items()]
    for record in results.records:
        lines += ["", f"## {record.name}", "", record.title, ""]
        if record.measured.figures:
            lines += ["| | minimum | median | p99 | count |", "|---|---|---|---|---|"]
        for one in record.measured.figures:
            cells = " | ".join(_values(one))
            lines.append(f"| {one.name} [{one.unit}] | {cells} | {one.count} |")
        if record.measured.figures:
            lines.append("")
        lines += [f"- {ratio.name} = **{number(ratio.value)}**" for ratio in record.measured.ratios]
        lines += [f"- {note}" for note in record.measured.notes]
    return "\n".join(lines) + "\n"


def number(value: float) -> str:
    """Three digits, or all before the point."""
    return f"{value:.3g}" if abs(value) < 999.5 else f"{value:,.0f}"


def _values(one: Figure) -> list[str]:
    """Smallest, middle and nearly largest value; the one there is where there is only one."""
    if one.count == 1:
        return ["", number(one.median), ""]
    return [number(value) for value in (one.minimum, one.median, one.p99)]
