#!/usr/bin/env python3
"""See to it that Chromium and its driver are there: the tests of pages look through them.

They are installed where nobody has to be asked: as root, where apt-get is. Elsewhere this says
what is missing; the tests that need a browser then say it again.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys

CHROMIUM = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
DRIVER = "chromedriver"
PACKAGES = ("chromium", "chromium-driver")
REMEDY = f"install Chromium and {DRIVER}, on Debian: apt install {' '.join(PACKAGES)}"


def is_there() -> bool:
    """Whether a browser and its driver are found."""
    return any(map(shutil.which, CHROMIUM)) and shutil.which(DRIVER) is not None


def install() -> bool:
    """Installs them; False if apt-get does not manage to."""
    apt = ["apt-get", "-y", "-qq"]
    for command in (
        [*apt, "update"],
        [*apt, "install", "--no-install-recommends", *PACKAGES],
    ):
        environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
        done = subprocess.run(
            command,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            check=False,
        )
        if done.returncode:
            return False
    return is_there()


def main() -> int:
    if is_there():
        return 0
    if os.geteuid() == 0 and shutil.which("apt-get"):
        print("installing Chromium for the tests of pages ...", flush=True)
        if install():
            return 0
    print(f"no browser for the tests of pages: {REMEDY}", file=sys.stderr)
    return 0


if __name__ == "__main__":
    sys.exit(main())
