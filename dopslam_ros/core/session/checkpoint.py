"""What of a filter is kept for later: its map, or all it needs to go on where it was."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from dopslam_ros.core.models.motion import Control, ControlSpan
from dopslam_ros.core.pmb import FilterParameters, Posterior
from dopslam_ros.core.pmb.known_map import map_of, with_map
from dopslam_ros.core.pmb.posterior import posterior_of

MAP, SNAPSHOT = "map", "snapshot"
# The stamp of a filter that has not processed a set yet.
BEFORE_ALL = -1
# What a filter must have in common with the one that saved.
_FOR_A_MAP = ("bs_position", "ue_height", "sp_field_of_view")
_MUST_AGREE = {MAP: _FOR_A_MAP, SNAPSHOT: (*_FOR_A_MAP, "coupling", "density", "mapping")}


class CheckpointError(ValueError):
    """Something saved that cannot be used; the message says why and what to do."""


@dataclass(frozen=True)
class Checkpoint:
    """A map, or a snapshot of a whole filter.

    Attributes:
        kind: MAP: the density has one hypothesis, without a vehicle; or SNAPSHOT.
        stamp_ns: time of the last set that is in it, or BEFORE_ALL.
        parameters: of the filter that saved it.
        posterior: the density.
        controls: with their stamps [ns], from the one in force at the stamp on.
        owed: motion that the density has still to make up for.
        known: the map as it was loaded, of a filter that only localises.
    """

    kind: str
    stamp_ns: int
    parameters: Mapping[str, Any]
    posterior: Posterior
    controls: tuple[tuple[int, Control], ...] = ()
    owed: tuple[ControlSpan, ...] = ()
    known: Checkpoint | None = None

    def check(self, kind: str, parameters: FilterParameters) -> None:
        """Whether a filter with these parameters can use it as such.

        Raises:
            CheckpointError: it is of another kind, or a parameter that must agree does not.
        """
        if self.kind != kind:
            raise CheckpointError(f"this is a {self.kind}, not a {kind}: give a {kind}")
        for name in _MUST_AGREE[kind]:
            theirs, ours = self.parameters.get(name), getattr(parameters, name)
            if not _same(theirs, ours):
                raise CheckpointError(
                    f"this {kind} was made with {name} = {theirs}, the filter has {name} ="
                    f" {ours}: start the filter with that value, or use another {kind}"
                )


def map_checkpoint(state: Posterior, stamp_ns: int, parameters: Mapping[str, Any]) -> Checkpoint:
    """The map of the likeliest hypothesis, with the parameters of its filter by name."""
    bare = posterior_of(map_of(state.density), state.inactive[0])
    return Checkpoint(MAP, stamp_ns, parameters, bare)


def in_map(vehicle: Posterior, known: Checkpoint, parameters: FilterParameters) -> Posterior:
    """The vehicle of the likeliest hypothesis in a map that it is independent of."""
    density = with_map(vehicle.density, known.posterior.density, parameters)
    return posterior_of(density, known.posterior.inactive[0])


def _same(theirs: Any, ours: Any) -> bool:
    if isinstance(ours, (tuple, list)):
        pairs = list(zip(theirs, ours, strict=False)) if isinstance(theirs, (tuple, list)) else []
        return len(pairs) == len(ours) == len(theirs or ()) and all(_same(*p) for p in pairs)
    if isinstance(ours, float):
        return isinstance(theirs, (int, float)) and math.isclose(theirs, ours, rel_tol=1e-12)
    return bool(theirs == ours)
