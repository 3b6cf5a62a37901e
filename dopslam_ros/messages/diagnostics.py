"""How a node is, as a message."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from dopslam_ros.messages import topics
from dopslam_ros.messages.common import Types, make_header


def make_diagnostics(
    types: Types,
    time_ns: int,
    name: str,
    level: int,
    summary: str,
    values: Iterable[tuple[str, Any]],
) -> Any:
    """A DiagnosticArray with one status; level 0 OK, 1 WARN, 2 ERROR."""
    key_value = types("diagnostic_msgs/msg/KeyValue")
    status = types("diagnostic_msgs/msg/DiagnosticStatus")(
        level=level,
        name=name,
        message=summary,
        hardware_id="",
        values=[key_value(key=key, value=str(value)) for key, value in values],
    )
    return types(topics.DIAGNOSTICS.type_name)(
        header=make_header(types, time_ns, ""), status=[status]
    )
