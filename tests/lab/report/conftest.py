"""A browser without a window, which looks at pages and tells what it saw and asked for."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tools.browser import CHROMIUM, DRIVER, REMEDY, is_there

ARGUMENTS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-dev-shm-usage",
    "--no-first-run",
    "--window-size=1500,950",
)


class Browser:
    """Chromium under the control of its driver.

    Attributes:
        driver: of selenium.
    """

    def __init__(self, profile: Path) -> None:
        from selenium import webdriver
        from selenium.webdriver.chrome.service import Service

        options = webdriver.ChromeOptions()
        options.binary_location = next(filter(None, map(shutil.which, CHROMIUM)))
        for argument in (*ARGUMENTS, f"--user-data-dir={profile}"):
            options.add_argument(argument)
        options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
        self.driver = webdriver.Chrome(options, Service(shutil.which(DRIVER)))
        self.driver.set_script_timeout(120)
        self._window = (0, 0, "")
        self._opened: tuple[Path, tuple[int, int, str]] | None = None

    def open(self, page: Path) -> None:
        """Loads a page until all of it is drawn; what was seen before is forgotten."""
        self._opened = page, self._window
        self.driver.get("about:blank")
        self.complaints()
        self.requests()
        self.driver.get(page.as_uri())
        self.wait(
            "(function look() { document.body.dataset.ready ? done() : setTimeout(look, 10) })()"
        )

    def show(self, page: Path) -> None:
        """Loads a page unless it was loaded last, in this window.

        It may be slid and played by then; tests that change anything else of it put that back.
        """
        if self._opened != (page, self._window):
            self.open(page)

    def run(self, script: str, *arguments: Any) -> Any:
        """What a piece of JavaScript returns."""
        return self.driver.execute_script(script, *arguments)

    def wait(self, script: str) -> Any:
        """What a piece of JavaScript passes to ``done``."""
        text = f"const done = arguments[arguments.length - 1]; {script}"
        return self.driver.execute_async_script(text)

    def frame(self) -> None:
        """Waits until what was asked for is drawn."""
        self.wait("requestAnimationFrame(() => requestAnimationFrame(done));")

    def press(self, key: str) -> None:
        """Presses a key with nothing in focus."""
        from selenium.webdriver.common.action_chains import ActionChains

        self.run("document.activeElement.blur()")
        ActionChains(self.driver).send_keys(key).perform()
        self.frame()

    def complaints(self) -> list[str]:
        """The lines of the console since they were last asked for."""
        return [entry["message"] for entry in self.driver.get_log("browser")]

    def requests(self) -> list[str]:
        """The addresses asked for since they were last asked for, data in the page left out."""
        events = [json.loads(e["message"])["message"] for e in self.driver.get_log("performance")]
        addresses = [
            event["params"]["request"]["url"]
            for event in events
            if event["method"] == "Network.requestWillBeSent"
        ]
        return [address for address in addresses if not address.startswith(("data:", "blob:"))]

    def emulate(self, width: int, height: int, scheme: str = "light") -> None:
        """Another window and another preference of the user."""
        self._window = width, height, scheme
        self.driver.execute_cdp_cmd(
            "Emulation.setDeviceMetricsOverride",
            {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False},
        )
        self.driver.execute_cdp_cmd(
            "Emulation.setEmulatedMedia",
            {"features": [{"name": "prefers-color-scheme", "value": scheme}]},
        )


@pytest.fixture(scope="session")
def session_browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    """One browser for all tests; where there is none, CI fails and others are told."""
    if not is_there():
        if os.environ.get("CI"):
            pytest.fail(f"the tests of pages need a browser: {REMEDY}")
        pytest.skip(f"needs a browser: {REMEDY}")
    browser = Browser(tmp_path_factory.mktemp("browser"))
    yield browser
    browser.driver.quit()


@pytest.fixture
def browser(session_browser: Browser) -> Browser:
    """The browser, its window and preferences as at the beginning."""
    session_browser.emulate(1500, 950)
    return session_browser
