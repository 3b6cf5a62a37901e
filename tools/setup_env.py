#!/usr/bin/env python3
"""Make `.venv` in the root of the repository: Python, ROS 2 Jazzy, the messages, this package.

With --oldest it makes `.venv-oldest`, with the oldest versions that are supported instead of the
newest (tools/oldest.txt).

Where ROS 2 Jazzy is sourced and belongs to the chosen Python, the environment stands on it. Where
it is not, Jazzy comes from wheels (pins in tools/ros-wheels.txt). Only what has changed since the
last run is done again. Needs nothing but the standard library. Everything the tools print goes to
`.venv/setup.log`.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import fcntl
import hashlib
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import sysconfig
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
OLDEST = "--oldest" in sys.argv
VENV = ROOT / (".venv-oldest" if OLDEST else ".venv")
STATE = VENV / ".setup"
LOG = VENV / "setup.log"

PACKAGE = "dopslam_ros"
MESSAGES = "dopslam_msgs"
TRANSFORMS = "tf2_msgs"
EXECUTABLES = ("simulator", "filter", "bounds", "recorder", "player", "dopslam")
PYTHONS = ("3.12", "3.11")
WHEEL_PINS = ROOT / "tools" / "ros-wheels.txt"
OLDEST_PINS = ROOT / "tools" / "oldest.txt"
LOADER_PATH = ROOT / "tools" / "loader_path.py"
BUILD_TOOLS = ("setuptools>=64", "wheel>=0.40")
LOG_TAIL_LINES = 25

# Variables of another Python or ROS, which must not reach into an environment made of wheels.
FOREIGN = (
    "PYTHONPATH",
    "LD_LIBRARY_PATH",
    "AMENT_PREFIX_PATH",
    "CMAKE_PREFIX_PATH",
    "COLCON_PREFIX_PATH",
)
WITHOUT_ROS = f"unset ROS_DISTRO {' '.join(FOREIGN)}; make setup"


class SetupError(Exception):
    """The set-up cannot go on; the text says why and what to do."""


@dataclass(frozen=True)
class Ros:
    """Where ROS comes from: from wheels, or from a sourced Jazzy.

    Attributes:
        home: Folder of the sourced rclpy; empty for the wheels.
        underlay: AMENT_PREFIX_PATH of the sourced ROS; empty for the wheels.
    """

    home: str = ""
    underlay: str = ""

    @property
    def sourced(self) -> bool:
        return bool(self.home)

    def __str__(self) -> str:
        return f"ROS in {self.home}" if self.home else "ROS from wheels"


# --- which Python, which ROS -----------------------------------------------------------------


def use_python(choice: str, arguments: Sequence[str]) -> None:
    """Continue in the chosen Python: `this`, a name or path, or `auto`.

    `auto` keeps the Python of an existing environment, so that `make PYTHON=python3.12` need be
    said only once. A virtual environment counts as the Python it was made from.
    """
    target = str(getattr(sys, "_base_executable", sys.executable))
    if choice == "auto":
        made_with = read_stamp("venv").get("python", "")
        target = made_with if os.access(made_with, os.X_OK) else target
    elif choice != "this":
        target = shutil.which(choice) or ""
        if not target:
            raise SetupError(f"There is no Python called {choice!r}.{python_advice()}")
    if choice == "this" and sys.prefix == sys.base_prefix:
        return
    # The guard of the wheels' start must not survive into a Python of another environment.
    os.environ.pop("_ROS_WHEELS_BOOTSTRAP_COMPLETE", None)
    os.execv(target, [target, str(Path(__file__).resolve()), *arguments, "--python", "this"])


def check_python() -> None:
    version = f"{sys.version_info.major}.{sys.version_info.minor}"
    if version not in PYTHONS:
        raise SetupError(
            f"Python {version} ({sys.executable}) does not do: ROS 2 Jazzy and its wheels are for "
            f"Python {' or '.join(reversed(PYTHONS))}.{python_advice()}"
        )


def python_advice() -> str:
    """Name the suitable Pythons of this machine, or how to get one."""
    found = [name for name in (f"python{version}" for version in PYTHONS) if runs(name)]
    if found:
        return f"\nFound {' and '.join(found)}; continue with: make setup PYTHON={found[0]}"
    return (
        f"\nInstall Python {PYTHONS[0]} (Ubuntu 24.04: apt install python3.12 python3.12-venv "
        "python3.12-dev), then: make setup PYTHON=python3.12"
    )


def runs(python: str) -> bool:
    if shutil.which(python) is None:
        return False
    return subprocess.run([python, "-c", ""], capture_output=True, check=False).returncode == 0


def find_ros() -> Ros:
    """Decide where ROS comes from; a ROS which cannot be used is an error, never skipped."""
    distro = os.environ.get("ROS_DISTRO", "")
    if distro not in ("", "jazzy"):
        raise SetupError(
            f"ROS_DISTRO={distro} is sourced, but {PACKAGE} is for ROS 2 Jazzy.\n"
            "Source Jazzy instead (source /opt/ros/jazzy/setup.bash), or go on without it, with "
            f"Jazzy from wheels:\n  {WITHOUT_ROS}"
        )
    home = folder_of_rclpy()
    # The environment file of the wheels sets ROS_DISTRO too, but puts no rclpy on the path.
    if not (distro and home):
        return Ros()
    check_rclpy()
    return Ros(home, underlay())


def folder_of_rclpy() -> str:
    """Return the first folder with rclpy on this Python's path, outside the environment itself."""
    folders = (Path(folder) for folder in sys.path if folder)
    return next((str(f) for f in folders if (f / "rclpy").is_dir() and f != site_packages()), "")


def check_rclpy() -> None:
    trial = subprocess.run(
        [sys.executable, "-c", "import rclpy"], capture_output=True, text=True, check=False
    )
    if trial.returncode:
        reason = (trial.stderr.strip().splitlines() or ["no message"])[-1]
        raise SetupError(
            f"ROS 2 Jazzy is sourced, but its rclpy does not import in {sys.executable}:\n"
            f"  {reason}\n"
            "Choose the Python which this ROS was built for (Ubuntu 24.04: make setup "
            "PYTHON=/usr/bin/python3), or go on with Jazzy from wheels:\n"
            f"  {WITHOUT_ROS}"
        )


def underlay() -> str:
    """Return AMENT_PREFIX_PATH without this environment, which ros_env.sh may have put there."""
    parts = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    return os.pathsep.join(part for part in parts if part and Path(part).resolve() != VENV)


# --- what is missing on this machine ---------------------------------------------------------


def check_machine() -> None:
    """Look for the tools that building needs, all at once, before anything is made."""
    version = f"{sys.version_info.major}.{sys.version_info.minor}"
    header = Path(sysconfig.get_paths()["include"]) / "Python.h"
    c, cxx = os.environ.get("CC"), os.environ.get("CXX")
    needs = [
        (has_any(c, "cc", "gcc", "clang"), "a C compiler", "build-essential"),
        (has_any(cxx, "c++", "g++", "clang++"), "a C++ compiler", "build-essential"),
        (has_any("cmake"), "cmake", "cmake"),
        (has_any("ninja", "make"), "ninja or make", "build-essential"),
        (header.is_file(), f"Python's headers ({header})", f"python{version}-dev"),
        (has_venv(), "Python's venv module with ensurepip", f"python{version}-venv"),
    ]
    missing = [(what, package) for present, what, package in needs if not present]
    if missing:
        packages = " ".join(dict.fromkeys(package for _, package in missing))
        raise SetupError(
            "Building the messages needs what this machine lacks:\n"
            + "".join(f"  - {what}\n" for what, _ in missing)
            + f"On Ubuntu or Debian: sudo apt install {packages}\nThen run make setup again."
        )


def has_any(*programs: str | None) -> bool:
    """Tell whether one of the programs is there; CC and CXX may carry options."""
    commands = [shlex.split(program)[0] for program in programs if program]
    return any(shutil.which(command) for command in commands)


def has_venv() -> bool:
    # Debian splits ensurepip off: the module venv alone does not tell.
    trial = subprocess.run(
        [sys.executable, "-c", "import venv, ensurepip"], capture_output=True, check=False
    )
    return trial.returncode == 0


# --- stamps: what was done, from which inputs --------------------------------------------------


def read_stamp(stage: str) -> dict[str, Any]:
    """Return what the finished stage has noted, or an empty dictionary."""
    try:
        stamp = json.loads((STATE / f"{stage}.json").read_text())
    except (OSError, ValueError):
        return {}
    return stamp if isinstance(stamp, dict) else {}


def is_done(stage: str, key: str) -> bool:
    return read_stamp(stage).get("key") == key


@contextlib.contextmanager
def stage(name: str, key: str, **notes: str) -> Iterator[None]:
    """Do a stage: its stamp goes first and is written last, so that half a stage never counts."""
    STATE.mkdir(parents=True, exist_ok=True)
    stamp = STATE / f"{name}.json"
    stamp.unlink(missing_ok=True)
    yield
    draft = stamp.with_suffix(".tmp")
    draft.write_text(json.dumps({"key": key, **notes}))
    draft.replace(stamp)


def digest(files: Iterable[Path], *facts: str) -> str:
    """Hash facts and files, the files by their path in the repository and their content."""
    total = hashlib.sha256("\0".join(facts).encode())
    for path in sorted(files):
        content = hashlib.sha256(path.read_bytes()).hexdigest()
        total.update(f"{path.relative_to(ROOT)} {content}\n".encode())
    return total.hexdigest()


# --- running programs --------------------------------------------------------------------------


def environment(ros: Ros) -> dict[str, str]:
    """Return the environment in which the tools run: this venv first, nothing foreign."""
    env = dict(os.environ)
    for name in ("PYTHONHOME", "VIRTUAL_ENV", *(() if ros.sourced else FOREIGN)):
        env.pop(name, None)
    prefixes = os.pathsep.join(part for part in (str(VENV), ros.underlay) if part)
    env.update(
        PATH=f"{VENV / 'bin'}{os.pathsep}{env.get('PATH', os.defpath)}",
        AMENT_PREFIX_PATH=prefixes,
        CMAKE_PREFIX_PATH=prefixes,
        PIP_DISABLE_PIP_VERSION_CHECK="1",
        PIP_NO_INPUT="1",
        PIP_USER="0",
        # Neither pip nor the generators load ROS libraries: spare them the wheels' restart.
        _ROS_WHEELS_BOOTSTRAP_COMPLETE="1",
    )
    return env


def run(command: Sequence[str], ros: Ros, what: str) -> None:
    """Run a program with its output in the log; on failure show the end of the log."""
    with LOG.open("a") as log:
        log.write(f"\n$ {shlex.join(command)}\n")
        log.flush()
        status = subprocess.run(
            command,
            cwd=ROOT,
            env=environment(ros),
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            check=False,
        ).returncode
    if status:
        tail = LOG.read_text(errors="replace").splitlines()[-LOG_TAIL_LINES:]
        raise SetupError(
            f"{what} failed (exit status {status}). The end of {LOG.relative_to(ROOT)}:\n"
            + "".join(f"  | {line}\n" for line in tail)
            + "After mending the cause run make setup again: it goes on from here."
        )


def venv_python() -> str:
    return str(VENV / "bin" / "python")


def site_packages() -> Path:
    version = f"python{sys.version_info.major}.{sys.version_info.minor}"
    return VENV / "lib" / version / "site-packages"


# --- stage 1: an empty virtual environment -----------------------------------------------------


def make_venv(ros: Ros) -> None:
    """Make the environment afresh when its Python, place or ROS has changed, or it is half-made."""
    version = ".".join(map(str, sys.version_info[:3]))
    facts = f"Python {version} in {sys.base_prefix}, {ros}"
    key = digest([], facts, str(VENV))
    if is_done("venv", key) and not half_made().exists() and runs(venv_python()):
        return
    check_machine()
    before = read_stamp("venv").get("facts", facts)
    if VENV.exists() or VENV.is_symlink():
        remove_venv()
    say(1, f"making {VENV.name} with {facts}" + (f" (it was {before})" if before != facts else ""))
    STATE.mkdir(parents=True)
    with stage("venv", key, python=sys.executable, facts=facts):
        options = ["--system-site-packages"] if ros.sourced else []
        command = [sys.executable, "-m", "venv", *options, str(VENV)]
        run(command, ros, "Making the virtual environment")


def half_made() -> Path:
    """Return the mark of an environment in which an installation or removal was cut short."""
    return STATE / "half-made"


def remove_venv() -> None:
    if VENV.is_symlink() or (not STATE.is_dir() and any(VENV.iterdir())):
        raise SetupError(
            f"{VENV} is there, but this script has not made it. Move it away or delete it, then "
            "run make setup again."
        )
    if STATE.is_dir():
        half_made().touch()
    # The state goes last, so that a removal cut short is still known as ours and half-made.
    for path in VENV.iterdir():
        if path != STATE:
            remove(path)
    shutil.rmtree(VENV)


def remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink()


def install_loader_path() -> None:
    """Let every Python of this environment find the libraries of ROS and of the messages."""
    site = site_packages()
    shutil.copyfile(LOADER_PATH, site / "_dopslam_loader_path.py")
    # .pth files are read in the order of their names: before ros_wheels_bootstrapper.pth.
    (site / "_dopslam_loader_path.pth").write_text("import _dopslam_loader_path\n")


# --- stage 2: ROS and the Python dependencies ----------------------------------------------------


def install_dependencies(ros: Ros) -> None:
    """Install everything in one go, so that NumPy is settled before anything is built on it."""
    inputs = [WHEEL_PINS, OLDEST_PINS, LOADER_PATH, ROOT / "setup.py"]
    key = digest(inputs, read_stamp("venv")["key"])
    if is_done("dependencies", key):
        return
    what = "Python packages beside the sourced ROS" if ros.sourced else "ROS 2 Jazzy from wheels"
    say(2, f"installing {what} ...")
    with stage("dependencies", key):
        half_made().touch()
        tools = BUILD_TOOLS if ros.sourced else ("-r", str(WHEEL_PINS))
        pip = [venv_python(), "-m", "pip", "install", *tools, *python_requirements()]
        try:
            run([*pip, *constraints(ros)], ros, "Installing the Python packages")
        except SetupError:
            half_made().unlink()  # pip has ended by itself and has taken its own work back
            raise
        if not ros.sourced:
            mend_cmake_paths(ros)
        install_loader_path()
        half_made().unlink()


def python_requirements() -> list[str]:
    """Read the dependencies, those of the tests too, from their one place: the call in setup.py."""
    for node in ast.walk(ast.parse((ROOT / "setup.py").read_text(encoding="utf-8"))):
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "setup":
            given = {item.arg: item.value for item in node.keywords}
            extras = ast.literal_eval(given["extras_require"])
            return [*ast.literal_eval(given["install_requires"]), *extras["test"]]
    raise SetupError(f"{ROOT / 'setup.py'} calls no setup(...) to read the dependencies from.")


def constraints(ros: Ros) -> list[str]:
    """Hold NumPy at the sourced ROS's version: its messages are compiled against that one."""
    if OLDEST:
        return ["-c", str(OLDEST_PINS)]
    version = numpy_version()
    if not ros.sourced or not version:
        return []
    file = STATE / "constraints.txt"
    file.write_text(f"numpy=={version}\n")
    return ["-c", str(file)]


def numpy_version() -> str:
    path = [str(site_packages()), *sys.path]
    found = metadata.distributions(name="numpy", path=path)
    return next((numpy.version for numpy in found), "")


def mend_cmake_paths(ros: Ros) -> None:
    """Point the CMake files of the wheels at this Python and NumPy, not at their builder's.

    NumPy is reached through a link, so that the files stay right when NumPy moves.
    """
    python = sysconfig.get_paths()["include"]
    numpy = VENV / "include" / "numpy-of-this-environment"
    link(numpy, numpy_include(ros))
    leaked = re.compile(r"/opt/python/cp\d+-cp\d+/(?:(include/python3\.\d+)|lib/[^\";\s]*/include)")
    for file in (VENV / "share").rglob("*.cmake"):
        text = file.read_text(encoding="utf-8")
        mended = leaked.sub(lambda match: python if match[1] else str(numpy), text)
        if mended != text:
            file.write_text(mended, encoding="utf-8")


def numpy_include(ros: Ros) -> Path:
    command = [venv_python(), "-c", "import numpy; print(numpy.get_include())"]
    answer = subprocess.run(
        command, env=environment(ros), stdout=subprocess.PIPE, text=True, check=True
    )
    return Path(answer.stdout.strip())


# --- stage 3: the messages -----------------------------------------------------------------------


def build_messages(ros: Ros) -> None:
    """Generate our message package, and that of /tf where ROS comes from wheels, which lack it."""
    build_package(ros, MESSAGES, ROOT / "msg_defs", "messages")
    if not ros.sourced:
        build_package(ros, TRANSFORMS, ROOT / "tools" / TRANSFORMS, "transforms")


def build_package(ros: Ros, name: str, source: Path, what: str) -> None:
    """Generate a message package and install it into the environment."""
    inputs = [WHEEL_PINS, *(path for path in source.rglob("*") if path.is_file())]
    key = digest(inputs, read_stamp("venv")["key"], numpy_version())
    if is_done(what, key):
        return
    say(3, f"generating the {what} ...")
    check_machine()
    build = STATE / "build"
    shutil.rmtree(build, ignore_errors=True)
    with stage(what, key):
        # Python3_ROOT_DIR and the rest keep CMake from preferring another Python of the machine.
        options = [
            f"-DCMAKE_INSTALL_PREFIX={VENV}",
            "-DCMAKE_BUILD_TYPE=Release",
            "-DBUILD_TESTING=OFF",
            f"-DPython3_ROOT_DIR={VENV}",
            f"-DPython3_EXECUTABLE={venv_python()}",
            "-DPython3_FIND_VIRTUALENV=ONLY",
            *(("-G", "Ninja") if shutil.which("ninja") else ()),
        ]
        configure = ["cmake", "-S", str(source), "-B", str(build), *options]
        run(configure, ros, f"Configuring the {what}")
        jobs = str(os.cpu_count() or 1)
        run(["cmake", "--build", str(build), "-j", jobs], ros, f"Building the {what}")
        remove_messages(name)
        run(["cmake", "--install", str(build)], ros, f"Installing the {what}")
    shutil.rmtree(build, ignore_errors=True)


def remove_messages(name: str) -> None:
    """Remove what an earlier build has installed: a deleted message must not linger."""
    patterns = (
        f"lib/python3*/site-packages/{name}*",
        f"lib/lib{name}__*",
        f"include/{name}",
        f"share/{name}",
        f"share/ament_index/resource_index/*/{name}",
    )
    for pattern in patterns:
        for path in list(VENV.glob(pattern)):
            remove(path)


# --- stage 4: this package -----------------------------------------------------------------------


def install_package(ros: Ros) -> None:
    """Install this package editable, with the folders `ros2 run` and the ament index look into."""
    inputs = [ROOT / name for name in ("setup.py", "setup.cfg", "pyproject.toml", "package.xml")]
    key = digest(inputs, read_stamp("venv")["key"], ros_environment_file(ros), *EXECUTABLES)
    if is_done("package", key):
        return
    say(4, f"installing {PACKAGE} ...")
    with stage("package", key):
        options = ["--no-deps", "--no-build-isolation", "--editable", str(ROOT)]
        run([venv_python(), "-m", "pip", "install", *options], ros, f"Installing {PACKAGE}")
        for name in EXECUTABLES:
            link(VENV / "lib" / PACKAGE / name, VENV / "bin" / name)
        index = VENV / "share" / "ament_index" / "resource_index" / "packages"
        link(index / PACKAGE, ROOT / "resource" / PACKAGE)
        for name in ("package.xml", "config", "launch", "bags"):
            link(VENV / "share" / PACKAGE / name, ROOT / name)
        (VENV / "ros_env.sh").write_text(ros_environment_file(ros))
        for shell in ("sh", "bash", "zsh"):
            # The name by which the install/setup.* of a colcon workspace sources its underlays.
            link(VENV / f"local_setup.{shell}", VENV / "ros_env.sh")


def link(path: Path, target: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)
    path.symlink_to(os.path.relpath(target, path.parent))


def ros_environment_file(ros: Ros) -> str:
    """Write the shell code which makes this environment the underlay of a colcon workspace."""
    libraries = str(VENV / "lib")
    lines = ["# To be sourced, for colcon and the ROS tools. Running the nodes does not need it."]
    lines.append(f"export VIRTUAL_ENV={shlex.quote(str(VENV))}")
    if ros.sourced:
        lines.append(prepend("PYTHONPATH", str(site_packages())))
    else:
        folders = sorted(str(path) for path in site_packages().glob("ros_*.libs"))
        libraries = os.pathsep.join([libraries, *folders])
        lines.append("export ROS_DISTRO=jazzy ROS_VERSION=2 ROS_PYTHON_VERSION=3")
        # Set together with LD_LIBRARY_PATH: one without the other breaks the wheels' start.
        lines.append("export _ROS_WHEELS_BOOTSTRAP_COMPLETE=1")
    lines.append(prepend("PATH", str(VENV / "bin")))
    lines.append(prepend("LD_LIBRARY_PATH", libraries))
    lines.append(prepend("AMENT_PREFIX_PATH", str(VENV)))
    lines.append(prepend("CMAKE_PREFIX_PATH", str(VENV)))
    return "\n".join(lines) + "\n"


def prepend(name: str, value: str) -> str:
    return f"export {name}={shlex.quote(value)}${{{name}:+:${name}}}"


# --- all together --------------------------------------------------------------------------------


def say(number: int, text: str) -> None:
    print(f"[{number}/4] {text}", flush=True)


@contextlib.contextmanager
def alone() -> Iterator[None]:
    """Let one set-up at a time work on this repository; the lock ends with the process."""
    # The folder itself is locked: a lock file inside .venv would vanish with it.
    folder = os.open(ROOT, os.O_RDONLY)
    try:
        try:
            fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            print("waiting for another set-up of this repository to end ...", flush=True)
            fcntl.flock(folder, fcntl.LOCK_EX)
        yield
    finally:
        os.close(folder)


def set_up(ros: Ros) -> None:
    started = time.monotonic()
    with alone():
        before = LOG.stat().st_mtime_ns if LOG.exists() else 0
        make_venv(ros)
        install_dependencies(ros)
        build_messages(ros)
        install_package(ros)
        worked = LOG.stat().st_mtime_ns != before
    if worked:
        print(f"ready in {time.monotonic() - started:.0f} s: {VENV.name}/bin/dopslam", flush=True)


def main(arguments: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n\n")[0])
    parser.add_argument(
        "--python",
        default="auto",
        metavar="NAME",
        help="Python to build on (default: that of an existing .venv, else the one running this)",
    )
    parser.add_argument(
        "--oldest", action="store_true", help="make .venv-oldest: the oldest versions supported"
    )
    options = parser.parse_args(arguments)
    try:
        use_python(options.python, ["--oldest"] if options.oldest else [])
        check_python()
        set_up(find_ros())
    except SetupError as error:
        print(f"set-up: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("\nset-up interrupted; make setup takes it up again.", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
