"""The page of a run, looked at through a browser."""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from dopslam_ros.bag import BagReader, BagWriter, message_class, serialize
from dopslam_ros.cli.main import main
from dopslam_ros.core.linalg.arrays import FloatArray
from dopslam_ros.messages import topics
from dopslam_ros.messages.diagnostics import make_diagnostics
from dopslam_ros.offline.replay import replay
from dopslam_ros.simulation.recording import write_simulation
from dopslam_ros.simulation.scenario import load_scenario

if TYPE_CHECKING:
    from tests.conftest import LiveRun
    from tests.lab.report.conftest import Browser

STEPS = 8
LONG = 2000
SCALES = "const {xaxis, yaxis} = map._fullLayout; return [xaxis._m, -yaxis._m];"
# Where the middle of the vehicle's ellipse is on the screen, and where that is on the map [m].
VEHICLE = """
    const number = map.layout.shapes.findIndex((shape) => shape.name === 'vehicle');
    const drawn = map.querySelector(`.shapelayer path[data-index="${number}"]`);
    const box = drawn.getBoundingClientRect(), frame = map.getBoundingClientRect();
    const {xaxis, yaxis} = map._fullLayout;
    return [xaxis.p2d((box.left + box.right) / 2 - frame.left - xaxis._offset),
            yaxis.p2d((box.top + box.bottom) / 2 - frame.top - yaxis._offset)];
"""


def made(bag: Path, folder: Path) -> Path:
    """The page about a bag."""
    out = folder / "run.html"
    assert main(["report", str(bag), "--out", str(out)]) == 0
    return out


@pytest.fixture(scope="module")
def page(live: LiveRun, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The report of the live run."""
    return made(live.bag, tmp_path_factory.mktemp("page"))


def test_its_numbers_come_as_json_too(live: LiveRun, tmp_path: Path) -> None:
    out, file = tmp_path / "run.html", tmp_path / "numbers.json"
    assert main(["report", str(live.bag), "--out", str(out), "--json", str(file)]) == 0
    content = json.loads(file.read_text("utf-8"))
    assert content["steps"] == STEPS
    assert f"{content['position_rmse']:.3f} m" in out.read_text("utf-8")


@pytest.fixture(scope="module")
def places(live: LiveRun) -> list[FloatArray]:
    """Where the filter says the vehicle is, by step."""
    return [output.state.ue_mean[:2] for output in replay(BagReader(live.bag)).outputs]


@pytest.fixture(scope="module")
def long_page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The report of a run of many steps."""
    folder = tmp_path_factory.mktemp("long")
    scene = folder / "long.yaml"
    scene.write_text(
        f"base: paper\ncontrols: [{{steps: {LONG}, speed: 22.22, turn_rate: 0.3141592653589793}}]\n"
    )
    with BagWriter(folder / "bag", flush_seconds=None) as writer:
        assert write_simulation(load_scenario(scene), 1, writer) == LONG
    return made(folder / "bag", folder)


def slide(browser: Browser, step: int) -> None:
    """Moves the slider as a hand does."""
    browser.run("slider.value = arguments[0]; slider.dispatchEvent(new Event('input'))", step)
    browser.frame()


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
    plots = browser.run("return charts.map(({plot}) => plot.querySelectorAll('.trace').length)")
    assert len(plots) == 10 and all(plots)
    across, up = browser.run(SCALES)
    assert across == pytest.approx(up, rel=1e-6), "a metre is as long in x as in y"


def test_the_slider_moves_the_vehicle(
    page: Path, browser: Browser, places: list[FloatArray]
) -> None:
    """At every step the vehicle is drawn where the filter said, to half a pixel."""
    browser.show(page)
    half_a_pixel = 0.5 * browser.run("return metresPerPixel()")
    for step in (5, 2, STEPS - 1, 0):
        slide(browser, step)
        assert browser.run(VEHICLE) == pytest.approx(places[step], abs=half_a_pixel)
        assert f"step {step + 1} of {STEPS}" in browser.run("return now.textContent")


def test_a_zoom_does_not_distort(page: Path, browser: Browser) -> None:
    """A metre is as long in x as in y, also after a zoom; the button shows all of it again."""
    browser.show(page)
    before, _ = browser.run(SCALES)
    browser.run("Plotly.relayout(map, {'xaxis.range': [0, 50]})")
    browser.frame()
    zoomed, up = browser.run(SCALES)
    assert zoomed == pytest.approx(up, rel=1e-6) and zoomed > 2 * before
    browser.run("document.getElementById('fit').click()")
    browser.frame()
    assert browser.run(SCALES) == pytest.approx([before, before], rel=1e-6)


def test_play_goes_on_to_the_end(page: Path, browser: Browser) -> None:
    """Play shows one step after the other, at the speed chosen, and stops at the end."""
    browser.show(page)
    slide(browser, 0)
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

    browser.show(page)
    slide(browser, 0)
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


def test_the_charts_have_a_cursor_at_the_step(page: Path, browser: Browser) -> None:
    """It stands on the step's own point of the line, in every chart."""
    browser.show(page)
    slide(browser, 5)
    off = browser.run(
        "return charts.map(({plot, cursor}) => { const axis = plot._fullLayout.xaxis;"
        " const left = axis._offset + axis.l2p(columns.time[5]);"
        " const {left: edge} = plot.getBoundingClientRect();"
        " return Math.abs(cursor.getBoundingClientRect().left - edge - left); })"
    )
    assert len(off) == 10 and max(off) < 1.0


def test_the_theme_can_be_changed(page: Path, browser: Browser) -> None:
    """The button turns light into dark, also in the charts and the map, where it stays put."""
    browser.show(page)
    slide(browser, 3)
    look = (
        "return [getComputedStyle(document.body).backgroundColor,"
        " charts[0].plot.data[0].line.color, map.layout.shapes.at(-1).fillcolor]"
    )
    before = browser.run(look)
    browser.run("document.getElementById('theme').click()")
    browser.frame()
    after = browser.run(look)
    assert all(one != other for one, other in zip(before, after, strict=True))
    assert browser.run("return [shown, mapStep]") == [3, 3]
    browser.run("document.getElementById('theme').click()")
    browser.frame()
    assert browser.run(look) == before
    assert not browser.complaints()


def test_layers_can_be_hidden(page: Path, browser: Browser) -> None:
    """A box of the legend takes its things off the map and puts them back."""
    browser.show(page)
    count = "return map.layout.shapes.length + map.data.filter((t) => t.visible !== false).length"
    everything = browser.run(count)
    boxes = "const box = document.querySelector('#layers input[value=va]'); box.click();"
    browser.run(boxes)
    assert browser.run(count) < everything
    browser.run(boxes)
    assert browser.run(count) == everything


def test_many_steps_stay_fluid(
    page: Path, long_page: Path, browser: Browser, record_property: Any
) -> None:
    """A step of a long run is shown nearly as fast as one of a short run.

    And in a part of the time that the library takes to draw the map anew. The times are the least
    of many, which others on this machine disturb the least, and are compared, not judged.
    """
    timed = """
        const times = [];
        for (let i = 0; i < TIMES; i++) {
          // At the end, where the track driven is longest.
          const k = steps - 1 - (i % 8), begin = performance.now();
          MAKE
          map.getBoundingClientRect();
          times.push(performance.now() - begin);
        }
        return Math.min(...times);
    """
    browser.show(page)
    short = browser.run(timed.replace("MAKE", "shown = -1; show(k);").replace("TIMES", "16"))
    browser.open(long_page)
    assert browser.run("return steps") == LONG
    assert not browser.complaints()
    shown = browser.run(timed.replace("MAKE", "shown = -1; show(k);").replace("TIMES", "16"))
    redrawn = browser.run(timed.replace("MAKE", "Plotly.redraw(map);").replace("TIMES", "8"))
    for name, value in (("short", short), ("long", shown), ("redraw", redrawn)):
        record_property(f"{name}_ms", value)
    print(
        f"a step of {LONG} in {shown:.1f} ms, of {STEPS} in {short:.1f} ms; redraw {redrawn:.1f} ms"
    )
    assert shown < 5.0 * short
    assert shown < 0.6 * redrawn


@dataclass(frozen=True)
class Odd:
    """A bag without truth, with markup in its name and in what nodes said; and its page."""

    bag: Path
    page: Path


EVIL = "</script><script>window.harm = 1</script><img src=x onerror='window.harm = 1'>&amp;"


@pytest.fixture(scope="module")
def odd(live: LiveRun, tmp_path_factory: pytest.TempPathFactory) -> Odd:
    """As few vehicles drive about."""
    folder = tmp_path_factory.mktemp("odd")
    bag = folder / "<img src=x onerror=harm()>"
    with BagWriter(bag) as writer:
        for message in BagReader(live.bag).messages({"/channel_measurements", "/odometry_control"}):
            writer.add_topic(message.topic, message.type_name)
            writer.write(message.topic, message.payload, message.log_time_ns)
        name, kind = topics.DIAGNOSTICS.name, topics.DIAGNOSTICS.type_name
        writer.add_topic(name, kind)
        said = make_diagnostics(message_class, 1, EVIL, 0, EVIL, [(EVIL, EVIL)])
        writer.write(name, serialize(said, kind), message.log_time_ns)
    return Odd(bag, made(bag, folder))


def test_texts_of_a_bag_stay_texts(odd: Odd, browser: Browser) -> None:
    """Tags and scripts in a bag and in its name are shown, never run."""
    browser.open(odd.page)
    assert not browser.complaints()
    assert browser.run("return window.harm") is None
    assert browser.run("return document.querySelectorAll('main img, header img').length") == 0
    assert browser.run("return document.querySelector('h1').textContent") == odd.bag.name
    text = "return document.getElementById('section-{}').textContent"
    assert EVIL in browser.run(text.format("problems"))
    assert str(odd.bag) in browser.run(text.format("parameters"))
    assert len(browser.requests()) == 1


def test_a_run_without_truth(odd: Odd, browser: Browser) -> None:
    """What needs the truth says so; the rest is there and works."""
    browser.show(odd.page)
    assert not browser.complaints()
    text = browser.run("return document.querySelector('main').innerText")
    assert "No truth in this bag" in text and "This needs the truth" in text
    assert "RMSE" not in text and "mean NEES" not in text
    keys = browser.run("return data.charts.map((chart) => chart.key)")
    assert keys == [
        "error-position",
        "error-heading",
        "error-clock",
        "nis",
        "sources",
        "weights",
        "times",
    ]
    slide(browser, 4)
    assert browser.run("return shown") == 4


def test_a_damaged_bag(cut_bag: Path, tmp_path: Path, browser: Browser) -> None:
    """The page says what is missing, and how the rest is saved."""
    browser.open(made(cut_bag, tmp_path))
    notice = browser.run("return document.querySelector('.notice').textContent")
    assert str(BagReader(cut_bag).damage) in notice and "dopslam recover" in notice
    assert not browser.complaints()


def test_nothing_to_show(live: LiveRun, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A bag without a single set gives no page but a reason."""
    with BagWriter(tmp_path / "bag") as writer:
        for name, info in BagReader(live.bag).topics.items():
            writer.add_topic(name, info.type_name)
    assert main(["report", str(tmp_path / "bag"), "--out", str(tmp_path / "x.html")]) == 1
    assert "no measurement set" in capsys.readouterr().err
    assert not (tmp_path / "x.html").exists()


def test_the_page_is_named_after_the_bag(
    simulated: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without --out the page lies in the folder where one is."""
    shutil.copytree(simulated, tmp_path / "drive")
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    assert main(["report", str(tmp_path / "drive")]) == 0
    assert [path.name for path in Path().iterdir()] == ["drive.html"]
