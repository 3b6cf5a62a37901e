"""The page about one run."""

from __future__ import annotations

import math
from collections.abc import Iterable
from html import escape
from pathlib import Path

import numpy as np

from dopslam_ros.core.linalg.quantiles import chi_square
from dopslam_ros.core.settings.layout import LandmarkType
from dopslam_ros.core.settings.parameters import declarations
from dopslam_ros.lab.report.charts import SOURCE_COLOURS, Section, sections
from dopslam_ros.lab.report.page import DASHES as SWATCHES
from dopslam_ros.lab.report.page import (
    card,
    notice,
    page,
    section,
    swatch,
    table,
    tiles,
    time_range,
)
from dopslam_ros.lab.report.recorded import Reports
from dopslam_ros.lab.report.scene import NAMES, Source, extent_of, scene_of
from dopslam_ros.lab.report.series import Series, series_of
from dopslam_ros.messages.markers import ELLIPSOID_PROBABILITY
from dopslam_ros.offline.evaluation import summarise
from dopslam_ros.offline.replay_result import Replay

MAGNIFICATIONS = (1, 3, 10, 30)
# Ellipses are magnified until they are at least so large, over the size of the scene.
VISIBLE = 0.01
RAYS = {Source.NEW: "dash", Source.CLUTTER: "dot"}


class NothingToShow(ValueError):
    """A run without a single step; the message says what is missing."""


def run_page(run: Replay, name: str, bag: Path, recorded: Reports) -> str:
    """The HTML of the report of a run.

    Args:
        run: a replay.
        name: to head the page.
        bag: where it is, said among the parameters.
        recorded: what the live nodes counted, by node.

    Raises:
        NothingToShow: the run has no step.
        MissingLibrary: plotly is not installed.
    """
    if not run.outputs:
        raise NothingToShow(f"bag '{bag}' has no measurement set that can be filtered")
    scene = scene_of(run)
    series = series_of(run) | _counts(scene, len(run.outputs))
    has_truth = bool(np.isfinite(series["error_position"]).any())
    shown = sections(has_truth, bool(run.bounds))
    extent = extent_of(run, scene)
    magnified = _magnification(scene, extent)
    data = {
        "xTitle": "time [s]",
        "xRange": time_range(series["time"]),
        "extent": extent,
        "bs": run.parameters.bs[:2].tolist(),
        "truth": _true_landmarks(run),
        "sources": [
            {"name": NAMES[s], "colour": SOURCE_COLOURS[s], "dash": RAYS.get(s, "solid")}
            for s in Source
        ],
        "deviations": math.sqrt(float(chi_square(ELLIPSOID_PROBABILITY, 2))),
        "magnified": magnified,
    }
    charts = [chart for one in shown if has_truth or not one.needs_truth for chart in one.charts]
    body = _body(run, name, bag, recorded, series, shown, has_truth, magnified)
    return page(f"{name} – run", body, data, {**scene, **series}, charts, SCRIPTS)


SCRIPTS = ("charts.js", "map.js", "player.js")


def _counts(scene: Series, steps: int) -> Series:
    """How many paths of each source a step has."""
    number = np.repeat(np.arange(steps), np.diff(scene["path_start"]).astype(int))
    return {
        f"count_{source.name.lower()}": np.bincount(
            number[scene["path_source"] == source], minlength=steps
        ).astype(float)
        for source in Source
    }


def _true_landmarks(run: Replay) -> dict[str, list[list[float]]]:
    found = {}
    for kind in (LandmarkType.VA, LandmarkType.SP):
        places = np.zeros((0, 3)) if run.true_map is None else run.true_map.of_type(kind)
        found[kind.name.lower()] = [places[:, 0].tolist(), places[:, 1].tolist()]
    return found


def _magnification(scene: Series, extent: tuple[float, float, float, float]) -> int:
    """The least one that makes the vehicle's ellipse visible."""
    size = max(extent[1] - extent[0], extent[3] - extent[2])
    radius = 2.45 * float(np.median(np.sqrt(scene["pxx"] + scene["pyy"])))
    enough = [m for m in MAGNIFICATIONS if m * radius >= VISIBLE * size]
    return enough[0] if enough else MAGNIFICATIONS[-1]


# --- the body ------------------------------------------------------------------------------------


def _body(
    run: Replay,
    name: str,
    bag: Path,
    recorded: Reports,
    series: Series,
    shown: Iterable[Section],
    has_truth: bool,
    magnified: int,
) -> str:
    notices = []
    if run.damage:
        notices.append(notice(f"Damaged bag: {run.damage}"))
    if not has_truth:
        notices.append(
            notice(
                "No truth in this bag: errors, NEES and GOSPA cannot be shown. The bounds are"
                " evaluated at the estimate."
            )
        )
    steps, seconds = len(run.outputs), float(series["time"][-1])
    stage = card("stage", _stage(steps, has_truth, bool(run.bounds), magnified))
    return (
        f'<header><h1>{escape(name)}</h1><button id="theme" type="button">Dark</button>'
        f"<p>{steps} steps in {seconds:.1f} s, filtered anew by this report</p></header>"
        f"<main>{''.join(notices)}{tiles(_numbers(run))}"
        f'<div class="columns"><div class="stage">{stage}</div><div class="charts">'
        f"{''.join(section(one, has_truth) for one in shown)}"
        f"{card('problems', _problems(run, recorded))}{card('parameters', _parameters(run, bag))}"
        "</div></div></main><footer>Drawn by plotly.js (MIT licence). Keys: space plays, the arrows"
        " step, Home and End jump; a click into a chart goes to its time.</footer>"
    )


def _numbers(run: Replay) -> Iterable[tuple[str, str, str]]:
    """Value with its unit, what it is, and what to compare it with."""
    summary = summarise(run.records())
    for ours, bound, unit, name in (
        ("position_rmse", "bound_position_rms", "m", "position RMSE"),
        ("heading_rmse_deg", "bound_heading_rms_deg", "deg", "heading RMSE"),
        ("clock_bias_rmse", "bound_clock_rms", "m", "clock bias RMSE"),
    ):
        if ours in summary:
            ratio = f"{summary[ours] / summary[bound]:.2f} × bound" if bound in summary else ""
            yield f"{summary[ours]:.3f} {unit}", name, ratio
    if "nees_mean" in summary:
        yield f"{summary['nees_mean']:.2f}", "mean NEES", "ideal 4"
    for key, name in (("gospa_va", "walls"), ("gospa_sp", "objects")):
        if key in summary:
            yield f"{np.mean(summary[key][-10:]):.2f} m", f"GOSPA, {name}", "last 10 steps"
    yield str(len(run.outputs[-1].landmarks.ids)), "landmarks", "at the end"
    slowest = f"99 %: {summary['step_ms_p99']:.2f} ms"
    yield f"{summary['step_ms_p50']:.2f} ms", "time of a step", slowest
    yield str(sum(run.problems.values())), "refused", "and other trouble"


def _stage(steps: int, has_truth: bool, has_bounds: bool, magnified: int) -> str:
    options = "".join(
        f'<option value="{m}"{" selected" if m == magnified else ""}>ellipses ×{m}</option>'
        for m in MAGNIFICATIONS
    )
    speeds = "".join(
        f'<option value="{s}"{" selected" if s == 1 else ""}>{s:g}× speed</option>'
        for s in (0.25, 0.5, 1, 2, 5, 10, 50)
    )
    columns = [("sigma", "sigma")]
    columns += [("error", "error")] if has_truth else []
    columns += [("bound", "bound")] if has_bounds else []
    rows = "".join(
        f"<tr><td>{escape(name)}</td>"
        + "".join(f"<td data-column='{c}_{key}' data-digits='3'></td>" for c, _ in columns)
        + "</tr>"
        for key, name in (
            ("position", "position [m]"),
            ("heading", "heading [deg]"),
            ("clock", "clock bias [m]"),
        )
    )
    head = "".join(f"<th>{text}</th>" for _, text in columns)
    return (
        "<h2>The drive from above</h2>"
        '<p class="soft">Bent lines are the paths of the moment, from the vehicle over what'
        " reflects them to the base station. Landmarks are the fainter the less likely they exist,"
        " hollow until they are reported; ellipses hold the truth with"
        f" {ELLIPSOID_PROBABILITY:.0%}.</p>"
        '<div id="map" role="img" aria-label="map"></div>'
        '<div class="controls"><div class="player">'
        '<button id="play" type="button" aria-pressed="false">Play</button>'
        f'<input id="step" type="range" min="0" max="{steps - 1}" value="0" aria-label="step">'
        '<output id="now"></output></div><div class="options">'
        f'<select id="speed" aria-label="speed">{speeds}</select>'
        f'<select id="magnified" aria-label="size of ellipses">{options}</select>'
        '<button id="fit" type="button">Fit</button></div></div>'
        f'<div id="layers">{_layers(has_truth)}</div>'
        '<div class="details"><div><h3>Vehicle</h3><p id="pose"></p>'
        '<table id="numbers"><thead><tr><th></th>'
        f"{head}</tr></thead><tbody>{rows}</tbody></table></div>"
        "<div><h3>Paths of this set</h3>"
        + table(("from", "weight", "length [m]", "azimuth [deg]", "Doppler [m/s]"), (), "", "paths")
        + '<p class="soft" id="more-paths"></p></div></div>'
    )


def _layers(has_truth: bool) -> str:
    """What is on the map, with boxes to hide it."""
    things = [("truth", "truth", "truth", "")] if has_truth else []
    things += [
        ("estimate", "estimate", "estimate", ""),
        ("ellipses", "ellipses", "soft", "ring"),
        ("bs", "base station", "text", "up"),
        ("va", "wall (VA)", "va", "box"),
        ("sp", "object (SP)", "sp", "ball"),
    ]
    paths = [
        (f"ray{s}", NAMES[s], SOURCE_COLOURS[s][1:], SWATCHES.get(RAYS.get(s, ""), ""))
        for s in Source
    ]
    return "".join(
        f'<div role="group" aria-label="{title}"><b>{title}</b>'
        + "".join(
            f'<label><input type="checkbox" value="{group}" checked>{swatch(colour, kind)}'
            f"{escape(text)}</label>"
            for group, text, colour, kind in layers
        )
        + "</div>"
        for title, layers in (("Map", things), ("Paths", paths))
    )


def _problems(run: Replay, recorded: Reports) -> str:
    parts = [
        "<h2>Refused messages and other trouble</h2>",
        '<p class="soft">A message that cannot be used is refused whole and counted by its'
        " reason.</p>",
    ]
    if run.problems:
        rows = [(reason, str(count)) for reason, count in sorted(run.problems.items())]
        parts.append(table(("in this replay", "count"), rows, "words"))
    else:
        parts.append("<p>None in this replay.</p>")
    said = [(node, *item) for node, found in recorded.items() for item in found]
    if said:
        parts.append("<h3>What the live nodes last reported</h3>")
        parts.append(table(("node", "what", "value"), said, "words"))
    return "".join(parts)


def _parameters(run: Replay, bag: Path) -> str:
    parts = [
        "<h2>Parameters of the filter</h2>",
        '<p class="soft">As resolved for this run; a dot marks those that are not the default.'
        f" The bag: {escape(str(bag))}</p>",
    ]
    rows = []
    for declared in declarations(type(run.parameters)):
        value = getattr(run.parameters, declared.name)
        mark = "" if value == declared.default else "• "
        shown = ", ".join(f"{v:g}" for v in value) if isinstance(value, tuple) else str(value)
        unit = f" [{declared.unit}]" if declared.unit else ""
        rows.append((mark + declared.name, shown, declared.text + unit))
    parts.append(table(("name", "value", "meaning"), rows, "words"))
    return "".join(parts)
