"""Every command in the README and the documentation can be given as it is printed.

What is cheap is run, in the order of its page, in a folder like a clone; studies with fewer runs.
The rest is checked against what it would be read by: the Makefile, the parser, the declarations,
the plan of the launch file. What neither covers is run elsewhere, see ``ELSEWHERE``.
"""

from __future__ import annotations

import importlib
import re
import shlex
import shutil
from pathlib import Path

import pytest
import yaml

from dopslam_ros.cli import main as cli
from dopslam_ros.cli.commands.parameters import NODES
from dopslam_ros.core.settings.parameters import declarations, parse_assignment
from dopslam_ros.nodes.launching import plan

ROOT = Path(__file__).resolve().parents[2]
README = ROOT / "README.md"
PAGES = (README, *sorted((ROOT / "docs").glob("*.rst")))
# Commands of others, and the test that runs them.
ELSEWHERE = {
    "colcon": "tests/test_project.py",
    "source": "tests/test_project.py",
    "rosdep": "on a machine with ROS from apt only",
}
# Commands whose tests run them whole: they take long, or end what they measure.
PARSED_ONLY = ("bench", "demo", "watch")
# Of one page only: tests/study runs them in every form.
STUDIES, STUDIED = ("study", "figures"), "tutorials.rst"


def commands(page: Path) -> list[list[str]]:
    """The shell commands of a page, in words."""
    text = page.read_text("utf-8")
    if page.suffix == ".md":
        text = re.sub(r"^```.*?^```$", "", text, flags=re.M | re.S)
        lines = re.findall(r"^    (\S(?:.*\\\n)*.*)$", text, re.M)
    else:
        blocks = re.findall(r"\.\. code-block:: bash\n\n((?:   .*\n|\n)+)", text)
        lines = [line for block in blocks for line in block.splitlines() if line.strip()]
    return [shlex.split(line.replace("\\\n", " "), comments=True) for line in lines]


ALL = [(page.name, words) for page in PAGES for words in commands(page)]


def test_there_are_commands() -> None:
    """The pages are read as they are meant."""
    assert len(ALL) > 40
    assert {page for page, _ in ALL} >= {"README.md", "tutorials.rst", "using.rst"}


@pytest.mark.parametrize(("page", "words"), ALL, ids=[f"{p}: {' '.join(w)[:70]}" for p, w in ALL])
def test_what_reads_a_command_takes_it(page: str, words: list[str]) -> None:
    """Nothing misspelt, no option that is gone."""
    program, *rest = words
    if program == "make":
        targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text("utf-8"), re.M)
        assert rest[0] in targets
    elif program.endswith("dopslam"):
        cli._parser().parse_args(rest)
    elif words[:3] == ["ros2", "run", "dopslam_ros"]:
        check_node(rest[2], rest[3:])
    elif words[:2] == ["ros2", "launch"]:
        assert (ROOT / "launch" / rest[2]).is_file()
        given = dict(argument.split(":=") for argument in rest[3:])
        given.pop("params_file", None)
        assert plan(given)
    elif words[:3] == ["ros2", "service", "call"]:
        name, kind, *request = rest[2:]
        table = (ROOT / "docs" / "nodes.rst").read_text("utf-8")
        short = kind.replace("/srv/", "/")
        assert re.search(rf"``~/{name.removeprefix('/filter/')}``\n +- ``{short}``", table)
        assert all(isinstance(yaml.safe_load(text), dict) for text in request)
    else:
        assert program in ELSEWHERE, words


def check_node(node: str, rest: list[str]) -> None:
    """The arguments of a node: each parameter is declared and takes its value."""
    if node == "dopslam":
        cli._parser().parse_args(rest)
        return
    module, name = NODES[node]
    known = {d.name: d for d in declarations(getattr(importlib.import_module(module), name))}
    for flag, value in zip(rest[1::2], rest[2::2], strict=True):
        if flag == "-p":
            parameter, parsed = parse_assignment(value.replace(":=", "=", 1))
            known[parameter].check(parsed)
        elif flag == "--params-file":
            assert (ROOT / value).is_file()
        else:
            assert flag in ("-r", "--remap"), flag


@pytest.fixture
def clone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder like a clone, to run commands in."""
    for name in ("bags", "docs", "config"):
        shutil.copytree(ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns("_build"))
    shutil.copytree(ROOT / "bags" / "paper", tmp_path / "runs" / "cut_off")
    (file,) = (tmp_path / "runs" / "cut_off").glob("*.mcap")
    file.write_bytes(file.read_bytes()[:-5000])
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_of_a_page_run_in_order(page: Path, clone: Path) -> None:
    """Each finds what those before it left."""
    done = 0
    for program, *rest in commands(page):
        if not program.endswith("dopslam") or rest[0] in PARSED_ONLY:
            continue
        if rest[0] in STUDIES and page.name != STUDIED:
            continue
        if rest[0] == "study":
            rest = fewer_runs(rest)
        assert cli.main(rest) == 0, rest
        done += 1
    assert done or page.name not in ("README.md", "tutorials.rst")


def fewer_runs(words: list[str]) -> list[str]:
    """The same study of two runs."""
    if "--runs" in words:
        at = words.index("--runs")
        words = words[:at] + words[at + 2 :]
    return [*words, "--runs", "2"]


def test_the_readme_prints_the_example_that_is_tested() -> None:
    """Word for word."""
    example = (ROOT / "docs" / "examples" / "channel_estimator.py").read_text("utf-8")
    assert f"```python\n{example}```" in README.read_text("utf-8")


def test_links_and_pictures_of_the_readme_are_there() -> None:
    """Each leads to a file."""
    links = re.findall(r"\]\(([^)#]+)\)", README.read_text("utf-8"))
    assert len(links) > 8
    for link in links:
        assert link.startswith("https:") or (ROOT / link).exists(), link


def test_the_citation_is_complete() -> None:
    """What the format (1.2.0) requires, with this package's version and licence."""
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))
    assert set(citation) >= {"cff-version", "message", "title", "authors"}
    assert citation["cff-version"] == "1.2.0" and citation["type"] == "software"
    import dopslam_ros

    assert citation["version"] == dopslam_ros.__version__
    assert citation["license"] == "Apache-2.0"
    for reference in citation["references"]:
        assert set(reference) >= {"type", "title", "authors"}
