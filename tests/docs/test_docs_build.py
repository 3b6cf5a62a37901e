"""The documentation builds without a warning and says what the code says."""

from __future__ import annotations

import importlib
import re
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from dopslam_ros.cli.commands.parameters import NODES
from dopslam_ros.core.monitoring import health, pose_search, recovery
from dopslam_ros.core.pmb import FilterParameters
from dopslam_ros.core.settings.parameters import declarations
from dopslam_ros.messages import topics

if TYPE_CHECKING:
    from tests.conftest import Ros

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The pages, built as `make docs` builds them."""
    out = tmp_path_factory.mktemp("docs")
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", "-b", "html"]
    done = subprocess.run(
        [*command, "-d", str(out / "doctrees"), str(DOCS), str(out / "html")],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return out / "html"


def page(built: Path, name: str) -> str:
    """A page without its tags."""
    return re.sub(r"<[^>]+>", "", (built / f"{name}.html").read_text("utf-8"))


def test_the_reference_has_every_parameter_topic_and_message(built: Path) -> None:
    """As declared in the code and in msg_defs."""
    reference = page(built, "nodes")
    for module, name in NODES.values():
        for declared in declarations(getattr(importlib.import_module(module), name)):
            assert declared.name in reference
    for topic in (*topics.RECORDED, topics.FILTER_EVENTS):
        assert topic.name in reference
        assert topic.type_name.replace("/msg/", "/") in reference
    for file in [*(ROOT / "msg_defs").glob("msg/*.msg"), *(ROOT / "msg_defs").glob("srv/*.srv")]:
        last = [line for line in file.read_text("utf-8").splitlines() if line.strip()][-1]
        assert last.split()[-1] in reference and file.stem in reference


def test_the_reference_has_the_services_of_the_filter(ros: Ros) -> None:
    """Those that the node offers besides what every node has."""
    from dopslam_ros.nodes.filter import FilterNode

    node = ros.start(FilterNode)
    offered = {
        name.removeprefix("/filter/"): types[0].replace("/srv/", "/")
        for name, types in node.get_service_names_and_types_by_node("filter", "/")
        if not types[0].startswith(("rcl_interfaces/", "type_description_interfaces/"))
    }
    text = (DOCS / "nodes.rst").read_text("utf-8")
    found = re.findall(r"``~/(\w+)``\n +- ``([\w/]+)``", text)
    assert dict(found) == offered


def test_every_function_of_the_equations_names_its_equation() -> None:
    """The table of equations agrees with the docstrings, or those of the modules."""
    text = (DOCS / "equations.rst").read_text("utf-8")
    rows = re.findall(r"\* - (eqs?\. .+)\n +- .+\n +- ``([\w.]+)``", text)
    assert len(rows) >= 9
    for equation, path in rows:
        module_name, _, name = path.rpartition(".")
        function: Any = getattr(importlib.import_module(module_name), name)
        assert equation in function.__doc__, path


def test_figures_are_drawn_by_their_command(tmp_path: Path) -> None:
    """docs/draw.py draws those that the pages show, with the size of those in the repository."""
    from matplotlib.image import imread

    done = subprocess.run(
        [sys.executable, str(DOCS / "draw.py"), str(tmp_path)], check=False, capture_output=True
    )
    assert done.returncode == 0, done.stderr
    drawn = sorted(path.name for path in tmp_path.glob("*.png"))
    assert drawn == ["architecture.png", "density.png", "geometry.png"]
    for name in drawn:
        ours, theirs = imread(tmp_path / name), imread(DOCS / "figures" / name)
        assert ours.shape == theirs.shape
        assert np.abs(ours - theirs).mean() < 0.02  # another version sets letters otherwise


def test_what_is_said_of_health_is_what_the_code_does() -> None:
    """Every threshold and every figure in the page's section."""
    page = (DOCS / "using.rst").read_text("utf-8")
    section = page.partition("Whether to believe it")[2].partition("Maps that are kept")[0]
    for text in (
        f"``doubt`` reached {health.WARN_AT:g}:",
        f"``doubt`` reached {health.LOST_AT:g},",
        f"``health_position_std`` ({FilterParameters().health_position_std:g} m)",
        f"``nis_deviations`` is above {health.MORE_THAN_CHANCE:g}",
        f"are {health.MORE_THAN_CHANCE:g} standard deviations",
        f"in {health.LONGEST_SILENCE} sets",
        f"deviation is {pose_search.ANYWHERE[0]:g} m",
        f":sup:`{recovery.SURE:g}`",
        f":sup:`-{health.LOST_AT:g}`",
    ):
        assert text in section, text
    names = {name for name, _ in health.HEALTHY.figures}
    names |= {d.name for d in declarations(FilterParameters)}
    told = set(re.findall(r"``([a-z]+(?:_[a-z]+)+)``", section))
    assert told and told <= names
