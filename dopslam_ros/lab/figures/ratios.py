"""Every published number beside ours, as tables."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from io import StringIO
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

from dopslam_ros.lab.figures import numbers
from dopslam_ros.lab.figures.style import looks
from dopslam_ros.lab.published import Kind, Published, published
from dopslam_ros.lab.study.results import Results
from dopslam_ros.system.files import json_text

LANDMARKS: tuple[Kind, ...] = ("va", "sp")
# What stands for the filter where bounds are compared.
BOUND = "bound"
TITLES = {
    "bounds": "Bounds at the last step",
    "rmse": "RMSE over all steps and runs",
    "association": "Mean weight of the correct association",
    "gospa_va": "GOSPA distance of the virtual anchors, mean over runs",
    "gospa_sp": "GOSPA distance of the scattering points, mean over runs",
}


class Ratio(NamedTuple):
    """One published number and ours.

    Attributes:
        figure: the picture it is in.
        quantity: what it is.
        unit: of both numbers, "" for a pure number.
        sigma_d: Doppler noise [m/s], None for without Doppler.
        step: 1 ... K, None for a number over all steps or at the last one.
        filter: ours that is compared, or BOUND.
        published: their number.
        ours: our number.
    """

    figure: str
    quantity: str
    unit: str
    sigma_d: float | None
    step: int | None
    filter: str
    published: float
    ours: float

    @property
    def ratio(self) -> float:
        """Ours over theirs."""
        return self.ours / self.published

    def record(self) -> dict[str, Any]:
        """All of it by name, for files."""
        return {**self._asdict(), "ratio": self.ratio}


def all_ratios(results: Results) -> list[Ratio]:
    """The bounds, and what a study of the paper's scene has."""
    rows = list(_bounds())
    theirs = numbers.paper_beside(results)
    if theirs is not None:
        for sigma_d in numbers.cases(results):
            for name in looks(results.plan.filters):
                rows += _of_filter(results, theirs, name, sigma_d)
    order = list(TITLES)
    return sorted(rows, key=lambda row: order.index(row.figure))


def write_ratios(results: Results, folder: Path) -> dict[str, Any]:
    """Writes ``all_ratios`` as ratios.md, ratios.csv and ratios.json; returns what is in that.

    Raises:
        OSError: they cannot be written.
    """
    rows = all_ratios(results)
    records = [row.record() for row in rows]
    plan, runs = results.plan, len(results.run_numbers)
    head = f"{runs} runs of scene '{plan.scenario.name}', seed {plan.seed}. In brackets, ours over"
    (folder / "ratios.md").write_text(_markdown(rows, f"{head} theirs."), "utf-8")
    content = {"rows": records}
    (folder / "ratios.json").write_text(json_text(content), "utf-8")
    text = StringIO()
    writer = csv.DictWriter(text, [*Ratio._fields, "ratio"], lineterminator="\n")
    writer.writeheader()
    for record in records:
        sigma_d = "without" if record["sigma_d"] is None else record["sigma_d"]
        writer.writerow({**record, "sigma_d": sigma_d})
    (folder / "ratios.csv").write_text(text.getvalue(), "utf-8")
    return content


def _bounds() -> Iterator[Ratio]:
    units = {"peb": "m", "heb": "deg", "ceb": "m", "leb": "m"}
    for sigma_d in (*published().sigmas, None):
        theirs, ours = published().bounds_at(sigma_d), numbers.bounds_at(sigma_d)
        assert theirs is not None  # the paper has these very noises
        for name, unit in units.items():
            pair = getattr(theirs, name), getattr(ours, name)
            quantity = "mean LEB" if name == "leb" else name.upper()
            yield Ratio("bounds", quantity, unit, sigma_d, None, BOUND, *pair)


def _of_filter(
    results: Results, theirs: Published, name: str, sigma_d: float | None
) -> Iterator[Ratio]:
    """What both the paper and a filter of the study have."""
    bars = theirs.rmse_at(sigma_d)
    if bars is not None:
        rmse = numbers.root_mean(numbers.squared_errors(results, name, sigma_d))
        units = {"position": "m", "heading": "deg", "clock bias": "m"}
        for (quantity, unit), bar, mine in zip(units.items(), bars, rmse, strict=True):
            yield Ratio("rmse", quantity, unit, sigma_d, None, name, bar, mine)
    weights = numbers.curve(results, name, sigma_d, "correct_weight")
    weight = theirs.correct_weight_at(sigma_d)
    if weights is not None and weight is not None:
        pair = weight, float(weights.mean.mean())
        yield Ratio("association", "weight", "", sigma_d, None, name, *pair)
    for landmarks in LANDMARKS:
        figure = f"gospa_{landmarks}"
        ours = numbers.curve(results, name, sigma_d, figure)
        line = theirs.gospa_at(landmarks, sigma_d)
        if ours is not None and line is not None:
            pairs = zip(line.tolist(), ours.mean.tolist(), strict=True)
            for step, pair in enumerate(pairs, start=1):
                yield Ratio(figure, "GOSPA", "m", sigma_d, step, name, *pair)


def _markdown(rows: list[Ratio], head: str) -> str:
    parts = [f"# Ours beside the paper's\n\n{head}\n"]
    for figure, group in groupby(rows, key=lambda row: row.figure):
        parts.append(f"\n## {TITLES[figure]}\n\n" + _table(list(group)))
    return "".join(parts)


def _table(rows: list[Ratio]) -> str:
    """One figure: a line for each published number, a column for each filter."""
    filters = list(dict.fromkeys(row.filter for row in rows))
    lines: dict[tuple[Any, ...], dict[str, str]] = {}
    for row in rows:
        key = (row.quantity, row.unit, row.sigma_d, row.step)
        cells = lines.setdefault(key, {"published": f"{row.published:#.4g}"})
        cells[row.filter] = f"{row.ours:#.4g} ({row.ratio:.3f})"
    columns = ["sigma_d [m/s]", "step", "quantity", "published", *filters]
    text = ["| " + " | ".join(columns) + " |", "|" + "---|" * len(columns)]
    for (quantity, unit, sigma_d, step), cells in lines.items():
        line = [
            "without" if sigma_d is None else f"{sigma_d:g}",
            "" if step is None else str(step),
            f"{quantity} [{unit}]" if unit else quantity,
            *(cells.get(column, "") for column in columns[3:]),
        ]
        text.append("| " + " | ".join(line) + " |")
    return "\n".join(text) + "\n"
