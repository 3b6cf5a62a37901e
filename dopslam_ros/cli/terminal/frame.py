"""A board drawn as tables for a terminal."""

from __future__ import annotations

import math

import numpy as np
from rich.console import Group
from rich.table import Table
from rich.text import Text

from dopslam_ros.cli.terminal.board import COUNTED, Board, level_of
from dopslam_ros.core.settings.layout import LandmarkType
from dopslam_ros.messages import topics
from dopslam_ros.messages.states import read_map, read_ue_state

MOST_LANDMARKS = 16
COLOURS = {"OK": "green", "WARN": "yellow", "STALE": "magenta"}


def frame(board: Board) -> Group:
    """Vehicle, rates, landmarks and health, below each other."""
    return Group(_vehicle(board), _rates(board), _landmarks(board), _health(board))


def _vehicle(board: Board) -> Table:
    """The state with its standard deviations and, where the truth is known, its errors."""
    message = board.last.get(topics.UE_STATE.name)
    where = board.prefix.rstrip("/") or "/"
    table = Table(title=Text(f"vehicle {where}"), title_justify="left", expand=False)
    for column in ("", "estimate", "sigma", "error"):
        table.add_column(column, justify="left" if not column else "right")
    if message is None:
        table.add_row("no state yet", "", "", "")
        return table
    mean, covariance = read_ue_state(message)
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    error = board.error_of(message, mean)
    scale = (1.0, 1.0, math.degrees(1.0), 1.0)
    for number, label in enumerate(("x [m]", "y [m]", "heading [deg]", "clock bias [m]")):
        known = "" if error is None else f"{scale[number] * error[number]:+.3f}"
        table.add_row(
            Text(label),
            f"{scale[number] * mean[number]:.3f}",
            f"{scale[number] * sigma[number]:.3f}",
            known,
        )
    return table


def _rates(board: Board) -> Text:
    parts = [
        f"{topic.name} {rate:.1f}/s" if math.isfinite(rate := board.rate(topic)) else ""
        for topic in COUNTED
    ]
    text = "   ".join(filter(None, parts)) or "nothing comes twice yet"
    if board.refused:
        text += f"   unreadable: {board.refused}"
    return Text(text, style="cyan")


def _landmarks(board: Board) -> Table:
    """The surest ones first; the BS is known and left out."""
    message = board.last.get(topics.LANDMARKS.name)
    table = Table(title="landmarks", title_justify="left")
    for column in ("id", "type", "exists", "x [m]", "y [m]", "z [m]", "sigma [m]"):
        table.add_column(Text(column), justify="right")
    if message is None:
        return table
    found = read_map(message)
    exists = np.array([float(m.existence_probability) for m in message.landmarks])
    shown = [n for n in np.argsort(-exists, kind="stable") if found.types[n] != LandmarkType.BS]
    for n in shown[:MOST_LANDMARKS]:
        sigma = math.sqrt(max(float(np.trace(found.covariances[n])), 0.0))
        table.add_row(
            str(found.ids[n]),
            LandmarkType(int(found.types[n])).name,
            f"{exists[n]:.2f}",
            *(f"{value:.1f}" for value in found.positions[n]),
            f"{sigma:.2f}",
        )
    if len(shown) > MOST_LANDMARKS:
        table.caption = f"{len(shown) - MOST_LANDMARKS} more"
    return table


def _health(board: Board) -> Table:
    table = Table(title="health", title_justify="left", show_header=False)
    for name, status in sorted(board.health.items()):
        word = level_of(status)
        # As text: what others say is no markup.
        colour = COLOURS.get(word, "red")
        table.add_row(Text(name), Text(word, style=colour), Text(status.message))
    if not board.health:
        table.add_row("nobody has told its health yet")
    return table
