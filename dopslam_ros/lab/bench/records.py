"""What a benchmark gives, and what it takes to compare it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np


class NotMeasured(RuntimeError):
    """Something that a benchmark needs is not there; the message says what."""


@dataclass(frozen=True)
class Figure:
    """Something measured ``count`` times.

    Attributes:
        name: what.
        unit: of the values.
        count: how often.
        minimum: smallest value.
        median: middle value.
        p99: value that 99 % are below.
    """

    name: str
    unit: str
    count: int
    minimum: float
    median: float
    p99: float


@dataclass(frozen=True)
class Ratio:
    """Two figures of the same run held against each other: carries over to other machines."""

    name: str
    value: float


@dataclass(frozen=True)
class Measured:
    """What a benchmark found.

    Attributes:
        figures: what was measured.
        ratios: of the figures.
        notes: what a reader must know, such as what could not be measured.
    """

    figures: tuple[Figure, ...] = ()
    ratios: tuple[Ratio, ...] = ()
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Record:
    """The outcome of a benchmark.

    Attributes:
        name: of the benchmark.
        title: what was done, in a sentence.
        measured: what was found.
    """

    name: str
    title: str
    measured: Measured


def figure(name: str, unit: str, values: Sequence[float]) -> Figure:
    """The statistics of some values."""
    return Figure(
        name,
        unit,
        len(values),
        float(np.min(values)),
        float(np.median(values)),
        float(np.percentile(values, 99.0)),
    )


def milliseconds(name: str, seconds: Sequence[float]) -> Figure:
    """The statistics of times [s]."""
    return figure(name, "ms", [1e3 * value for value in seconds])


def times_as_long(one: Figure, other: Figure) -> Ratio:
    """How many times as long one figure takes as another, by their medians."""
    return Ratio(f"{one.name} / {other.name}", one.median / other.median)


def content_of(record: Record) -> dict[str, Any]:
    """A record as JSON takes it."""
    return {"name": record.name, "title": record.title, **asdict(record.measured)}


def read_record(content: Any) -> Record:
    """The record that ``content_of`` made JSON of.

    Raises:
        KeyError, TypeError: it is none.
    """
    measured = Measured(
        tuple(Figure(**one) for one in content["figures"]),
        tuple(Ratio(**one) for one in content["ratios"]),
        tuple(content["notes"]),
    )
    return Record(content["name"], content["title"], measured)
