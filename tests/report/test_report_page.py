"""The page of a run, looked at through a browser."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from dopslam_ros.bag import BagReader
from dopslam_ros.cli import main
from dopslam_ros.core.arrays import FloatArray
from dopslam_ros.replay import replay

if TYPE_CHECKING:
    from tests.conftest import LiveRun
    from tests.report.conftest import Browser

STEPS = 8
VEHICLE = "const t = map.data.at(-1); return [t.x[0], t.y[0]];"


@pytest.fixture(scope="module")
def page(live: LiveRun, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The report of the live run."""
    out = tmp_path_factory.mktemp("page") / "run.html"
    assert main(["report", str(live.bag), "--out", str(out)]) == 0
    return out


@pytest.fixture(scope="module")
def places(live: LiveRun) -> list[FloatArray]:
    """Where the filter says the vehicle is, by step."""
    return [output.state.ue_mean[:2] for output in replay(BagReader(live.bag)).outputs]


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [400, 1600])
def test_it_loads_alone_and_without_complaint(
    page: Path, browser: Browser, scheme: str, width: int
) -> None:
    """Nothing on the console, nothing asked for but the file itself, and nothing sticks out."""
    browser.emulate(width, 900, scheme)
    browser.open(page)
    assert browser.requests() == [page.as_uri()]
    assert not browser.complaints()
    assert browser.run("return document.documentElement.dataset.theme") == scheme
    assert browser.run("return document.documentElement.scrollWidth") <= width


def test_the_slider_moves_the_vehicle(
    page: Path, browser: Browser, places: list[FloatArray]
) -> None:
    """At every step the vehicle is where the filter said."""
    browser.open(page)
    for step in (5, 2, STEPS - 1, 0):
        browser.run("slider.value = arguments[0]; slider.dispatchEvent(new Event('input'))", step)
        browser.frame()
        assert browser.run(VEHICLE) == pytest.approx(places[step], abs=1e-3)
        assert f"step {step + 1} of {STEPS}" in browser.run("return now.textContent")


def test_play_goes_on_to_the_end(page: Path, browser: Browser) -> None:
    """Play shows one step after the other, at the speed chosen, and stops at the end."""
    browser.open(page)
    browser.run("speed.value = '10'; document.getElementById('play').click()")
    seen = browser.wait(
        "const seen = [shown]; (function look() { if (seen.at(-1) !== shown) seen.push(shown);"
        " if (player.playing) requestAnimationFrame(look); else done(seen); })();"
    )
    assert seen == sorted(seen) and seen[-1] == STEPS - 1
    assert browser.run("return playButton.textContent") == "Play"


def test_keys(page: Path, browser: Browser) -> None:
    """Arrows step, Home and End jump, space plays and pauses."""
    from selenium.webdriver.common.keys import Keys

    browser.open(page)
    expected = [
        (Keys.ARROW_RIGHT, 1),
        (Keys.ARROW_RIGHT, 2),
        (Keys.ARROW_LEFT, 1),
        (Keys.END, STEPS - 1),
        (Keys.ARROW_RIGHT, STEPS - 1),
        (Keys.HOME, 0),
    ]
    for key, step in expected:
        browser.press(key)
        assert browser.run("return shown") == step
    browser.press(" ")
    assert browser.run("return player.playing")
    browser.press(" ")
    assert not browser.run("return player.playing")
