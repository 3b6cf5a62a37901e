"""The documentation builds without a warning and says what the code says."""

from __future__ import annotations

import importlib
import re
import runpy
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


def rows_of_equations() -> list[tuple[str, str]]:
    """Each equation of the page, and the function beside it."""
    text = (DOCS / "equations.rst").read_text("utf-8")
    return re.findall(r"\* - ((?:EK-PMBM )?(?:eqs?\.|Section) .+)\n +- .+\n +- ``([\w.]+)``", text)


@pytest.mark.parametrize(("equation", "path"), rows_of_equations(), ids=str)
def test_every_function_of_the_equations_names_its_equation(equation: str, path: str) -> None:
    """The tables of equations agree with the docstrings."""
    module_name, _, name = path.rpartition(".")
    function: Any = getattr(importlib.import_module(module_name), name)
    assert re.search(rf"(?<!EK-PMBM ){re.escape(equation)}", function.__doc__)


def test_every_equation_of_the_paper_has_its_function() -> None:
    """All 32, but for the signal and the definition of the bound; another paper's are named so."""
    told: set[int] = set()
    for equation, _ in rows_of_equations():
        if not equation.startswith("EK-PMBM"):
            for first, last in re.findall(r"\((\d+)\)(?:-\((\d+)\))?", equation):
                told |= {*range(int(first), int(last or first) + 1)}
    assert told == {*range(1, 33)} - {2, 13, 14, 15, 16}
    sources = (ROOT / "dopslam_ros" / "core" / "pmb").glob("*.py")
    for file in sources:  # (22) and (23) are information in the one paper, weights in the other
        assert not re.search(r"(?<!EK-PMBM )eqs?\. \(2[234]\)", file.read_text("utf-8")), file


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


def test_the_picture_of_the_rooms_is_true() -> None:
    """Its arrows, and those that follow from them, are the ones that a test holds."""
    picture = runpy.run_path(str(DOCS / "draw.py"))
    held = runpy.run_path(str(ROOT / "tests" / "test_architecture.py"))

    def known(room: str) -> set[str]:
        found = set(picture["ARROWS"].get(room, ()))
        return found.union(*map(known, found))

    assert {room: known(room) for room in (*picture["ROOMS"], "core")} == held["ROOMS"]
    assert picture["CORE"] == held["CORE"]


def test_the_rooms_and_files_that_the_architecture_names_are_there() -> None:
    """Folders, files and modules."""
    text = (DOCS / "architecture.rst").read_text("utf-8")
    package = ROOT / "dopslam_ros"
    rooms = re.findall(r"^   \* - ``([\w/]+)``$", text, re.M)
    tops = {room.split("/")[0] for room in rooms}
    assert tops == {folder.parent.name for folder in package.glob("*/__init__.py")}
    for room in rooms:
        assert (package / room / "__init__.py").is_file(), room
    for name in re.findall(r"``((?:core|messages|cli)[./][\w./]*)``", text):
        path = package / (name if "/" in name else name.replace(".", "/"))
        assert path.exists() or path.with_suffix(".py").is_file(), name
    labs = text.partition("* - ``lab``")[2].partition("* -")[0]
    folders = {folder.parent.name for folder in (package / "lab").glob("*/__init__.py")}
    assert set(re.findall(r"``(\w+)``", labs)) == folders


def test_what_is_said_of_health_is_what_the_code_does() -> None:
    """Every threshold and every figure in the page's section."""
    page = (DOCS / "using.rst").read_text("utf-8")
    section = page.partition("Whether to believe it")[2].partition("Maps that are kept")[0]
    for text in (
        f"``cusum`` reached {health.WARN_AT:g}:",
        f"``cusum`` reached {health.LOST_AT:g},",
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
