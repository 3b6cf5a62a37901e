"""Nothing of ours is on its way out of Python or NumPy: warnings in our code are errors."""

from __future__ import annotations

import ast
import warnings
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SOURCES = sorted(
    file for folder in ("dopslam_ros", "tools") for file in (ROOT / folder).rglob("*.py")
)
# Gone from the standard library with Python 3.12 (PEP 632 and others) and 3.13 (PEP 594).
GONE = set(
    "asynchat asyncore distutils imp smtpd "
    "aifc audioop cgi cgitb chunk crypt imghdr mailcap msilib nis nntplib ossaudiodev pipes sndhdr "
    "spwd sunau telnetlib uu xdrlib lib2to3".split()
)
# Deprecated since 3.12 or removed in 3.13, by the attribute's name.
OUTDATED = {"utcnow", "utcfromtimestamp", "find_module", "load_module"}
WARN = 'import warnings; warnings.warn("on its way out", {kind})'


@pytest.mark.parametrize("kind", ["DeprecationWarning", "FutureWarning", "RuntimeWarning"])
@pytest.mark.parametrize("module", ["dopslam_ros", "dopslam_ros.core.pmb.step"])
def test_a_warning_in_our_code_is_an_error(module: str, kind: str) -> None:
    """The tests' settings act on every module of the package, whatever the kind of warning."""
    with pytest.raises(Warning, match="on its way out"):
        exec(WARN.format(kind=kind), {"__name__": module})


@pytest.mark.filterwarnings("default:on its way out:DeprecationWarning:elsewhere")
def test_a_warning_in_the_code_of_others_is_none() -> None:
    """Libraries may warn of themselves."""
    with warnings.catch_warnings(record=True) as caught:
        exec(WARN.format(kind="DeprecationWarning"), {"__name__": "elsewhere"})
    assert [str(warning.message) for warning in caught] == ["on its way out"]


@pytest.mark.parametrize("file", SOURCES, ids=lambda file: str(file.relative_to(ROOT)))
def test_nothing_is_used_that_newer_pythons_do_not_have(file: Path) -> None:
    """No module or name that 3.12 or 3.13 removed or deprecates; no warning of the compiler."""
    text = file.read_text("utf-8")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        compile(text, str(file), "exec")
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            assert not {alias.name.partition(".")[0] for alias in node.names} & GONE
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            assert node.module.partition(".")[0] not in GONE
        elif isinstance(node, ast.Attribute):
            assert node.attr not in OUTDATED
