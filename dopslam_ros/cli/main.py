# PYTHON_ARGCOMPLETE_OK
"""The ``dopslam`` command."""

from __future__ import annotations

import argparse
import difflib
import os
import re
import sys
from collections.abc import Sequence
from typing import Any, ClassVar, NoReturn, Protocol

from dopslam_ros import __version__
from dopslam_ros.cli.commands import (
    bench,
    bounds,
    compare,
    demo,
    figures,
    inject,
    parameters,
    recover,
    replay,
    report,
    saved_map,
    simulate,
    study,
    watch,
)
from dopslam_ros.cli.options import add_quiet, check_files, nearest_file
from dopslam_ros.cli.progress import silence
from dopslam_ros.core.settings.parameters import ParameterError
from dopslam_ros.system.errors import UsageError


class Command(Protocol):
    """What a module of ``dopslam_ros.cli.commands`` has."""

    TEXT: str
    EXAMPLE: str

    def add_arguments(self, parser: argparse.ArgumentParser, /) -> None: ...

    def run(self, options: Any, /) -> int: ...


COMMANDS: dict[str, Command] = {
    "demo": demo,
    "simulate": simulate,
    "replay": replay,
    "map": saved_map,
    "report": report,
    "compare": compare,
    "bounds": bounds,
    "study": study,
    "inject": inject,
    "figures": figures,
    "bench": bench,
    "parameters": parameters,
    "recover": recover,
    "watch": watch,
}
# By the new name what a command was called before; with the next release the old name goes.
OLD_NAMES = {"inject": "trouble"}

ENDING = """exit codes:
  0    it was done
  1    it failed: a file cannot be read or written, or results differ that should not
  2    it was asked wrongly: an option, a name or a value
  130  Ctrl-C ended it after the step it was at, a second one at once; what bench, bounds, demo,
       inject, replay, simulate, study and watch had by then is kept

completion in bash, also for this session alone:
  eval "$(register-python-argcomplete dopslam)"
"""
# Commands whose output is all that they are for.
TALKERS = ("parameters",)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs a command; returns 0, 1 if it failed, 2 if it was asked wrongly, 130 on Ctrl-C."""
    parser = _parser()
    if "_ARGCOMPLETE" in os.environ:  # the shell asks what could come next
        import argcomplete

        argcomplete.autocomplete(parser)
    options = parser.parse_args(arguments)
    try:
        check_files(options)
        with silence(getattr(options, "quiet", False)):
            _tell_new_name(options.command)
            return int(options.run(options))
    except (UsageError, ParameterError) as error:
        _complain(error)
        return 2
    except BrokenPipeError:  # whoever read our output has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except (OSError, ValueError, RuntimeError) as error:
        _complain(error, nearest_file(options))
        return 1
    except KeyboardInterrupt:
        print("dopslam: stopped", file=sys.stderr)
        return 130


def _tell_new_name(given: str) -> None:
    for name, old in OLD_NAMES.items():
        if given == old:
            print(
                f"dopslam: '{old}' is called '{name}' now; the old name goes with the next release",
                file=sys.stderr,
            )


def _complain(error: Exception, hint: str = "") -> None:
    """One line, also where a library's message has several."""
    print("dopslam:", " ".join(f"{error}{hint}".split()), file=sys.stderr)


class _Parser(argparse.ArgumentParser):
    """Where a name is wrong it says the nearest one that is right."""

    words: ClassVar[set[str]] = {*COMMANDS}

    def add_argument(self, *names: Any, **options: Any) -> argparse.Action:
        self.words.update(names, options.get("choices", ()))
        return super().add_argument(*names, **options)

    def error(self, message: str) -> NoReturn:
        wrong = re.search(r"(?:invalid choice: '?|unrecognized arguments: )([^\s'=]+)", message)
        near = difflib.get_close_matches(wrong[1], self.words, n=1) if wrong else []
        super().error(message + (f"; did you mean '{near[0]}'?" if near else ""))


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="dopslam",
        description="Online Doppler SLAM.",
        epilog=ENDING,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=__version__)
    commands = parser.add_subparsers(required=True, metavar="COMMAND", dest="command")
    for name, command in COMMANDS.items():
        old = OLD_NAMES.get(name)
        sub = commands.add_parser(
            name,
            aliases=[old] if old else [],
            help=command.TEXT + (f" (old name until the next release: {old})" if old else ""),
            description=command.TEXT,
            epilog=f"example:\n  {command.EXAMPLE}",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        sub.set_defaults(run=command.run)
        command.add_arguments(sub)
        if name not in TALKERS:
            add_quiet(sub)
    return parser


if __name__ == "__main__":
    raise SystemExit(main())
