"""Sphinx directives that write the reference from the code: parameters, topics, messages.

``.. node-parameters:: filter`` a table of the parameters a node declares;
``.. topic-table::`` every topic with its type, quality of service and publisher;
``.. interface:: msg/UeState`` a message or service as its file has it.
"""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

from docutils import nodes
from docutils.parsers.rst import Directive
from docutils.statemachine import StringList

from dopslam_ros.cli.commands.parameters import NODES
from dopslam_ros.core.settings.parameters import Declaration, declarations
from dopslam_ros.messages import topics

ROOT = Path(__file__).resolve().parents[2]
DESCRIPTIONS = {
    topics.CHANNEL_MEASUREMENTS: ("your estimator", "all paths of a snapshot"),
    topics.ODOMETRY_CONTROL: (
        "your odometry",
        "``linear.x`` speed, ``angular.z`` turn rate, from its stamp until the next",
    ),
    topics.TRUTH_UE: ("simulator", "the true state, for bounds and for judging"),
    topics.TRUTH_LANDMARKS: ("simulator", "the true map"),
    topics.FILTER_PARAMETERS: ("filter", "its resolved parameters as YAML"),
    topics.FILTER_EVENTS: ("filter", "what services did to it, so that a replay does the same"),
    topics.UE_STATE: ("filter", "x, y, heading, clock bias and their covariance"),
    topics.UE_POSE: ("filter", "the same as a pose"),
    topics.ODOMETRY: ("filter", "the same with twist"),
    topics.PATH: ("filter", "the way driven"),
    topics.LANDMARKS: ("filter", "ids, types, existence, positions, covariances"),
    topics.LANDMARK_MARKERS: ("filter", "bodies and 95 % ellipsoids"),
    topics.BOUNDS: ("bounds", "PEB, HEB, CEB, LEB, with and without Doppler"),
    topics.TF: ("filter", "the pose as a transform, with ``publish_tf``"),
    topics.DIAGNOSTICS: ("all", "what was processed and, by reason, what was refused"),
}


class Generated(Directive):
    """A directive that is parsed from the RST text that ``text`` returns."""

    def text(self) -> str:
        """The RST."""
        raise NotImplementedError

    def run(self) -> list[nodes.Node]:
        """Parses the text in the place of the directive."""
        container = nodes.container()
        lines = StringList(self.text().splitlines(), source="generated")
        self.state.nested_parse(lines, self.content_offset, container)
        return container.children


def table(header: tuple[str, ...], rows: list[tuple[str, ...]], widths: str) -> str:
    """An RST list-table."""
    lines = [".. list-table::", "   :header-rows: 1", f"   :widths: {widths}", ""]
    for row in (header, *rows):
        for number, cell in enumerate(row):
            lines.append(f"   {'*' if number == 0 else ' '} - {cell}")
    return "\n".join(lines)


class NodeParameters(Generated):
    """The parameters of a node."""

    required_arguments = 1

    def text(self) -> str:
        module, name = NODES[self.arguments[0]]
        kind = getattr(importlib.import_module(module), name)
        rows = [parameter_row(declared) for declared in declarations(kind)]
        return table(("parameter", "default", "unit", "allowed", "what"), rows, "20 16 10 14 40")


def parameter_row(declared: Declaration) -> tuple[str, ...]:
    """The cells of one parameter."""
    default: Any = declared.default
    shown = list(default) if isinstance(default, tuple) else default
    changes = " May change while the node runs." if declared.dynamic else ""
    text = declared.text.replace("*", "\\*").replace("|", "\\|").replace("_ ", "\\_ ")
    return (
        f"``{declared.name}``",
        f"``{shown!r}``",
        declared.unit,
        declared.range_text(),
        text + changes,
    )


class TopicTable(Generated):
    """Every topic."""

    def text(self) -> str:
        rows = [
            (
                f"``{topic.name}``",
                f"``{topic.type_name.replace('/msg/', '/')}``",
                "reliable, "
                + ("latched" if topic.latched else "volatile")
                + f", depth {topic.depth}",
                *about,
            )
            for topic, about in DESCRIPTIONS.items()
        ]
        return table(("topic", "type", "offered as", "from", "what"), rows, "18 24 18 12 28")


class Interface(Generated):
    """The file of a message or a service."""

    required_arguments = 1

    def text(self) -> str:
        kind = self.arguments[0].split("/")[0]
        file = ROOT / "msg_defs" / f"{self.arguments[0]}.{kind}"
        body = "".join(f"   {line}\n" for line in file.read_text("utf-8").splitlines())
        return f".. code-block:: none\n\n{body}"


def setup(app: Any) -> dict[str, Any]:
    """What Sphinx asks for."""
    app.add_directive("node-parameters", NodeParameters)
    app.add_directive("topic-table", TopicTable)
    app.add_directive("interface", Interface)
    return {"version": "1", "parallel_read_safe": True}
