"""``dopslam recover``: what is left of a damaged bag."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from dopslam_ros.cli.options import add_json, write_json

TEXT = "save what can be read of a damaged bag into a new one"
EXAMPLE = "dopslam recover runs/cut_off"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of the command."""
    parser.add_argument("old", type=Path, help="folder of a bag, or an .mcap file; stays as it is")
    parser.add_argument(
        "new", type=Path, nargs="?", help="folder of the new bag (default: OLD_recovered)"
    )
    add_json(parser)


def run(options: Any) -> int:
    """Writes the new bag."""
    from dopslam_ros.bag import BagReader
    from dopslam_ros.bag.repair import free_name, repair

    new = options.new or free_name(options.old)
    reader = repair(options.old, new)
    saved = BagReader(new).message_count
    print(f"{saved} messages of {options.old} are in {new}")
    if reader.damage:
        print(f"missing: {reader.damage}")
    content = {"bag": str(new), "messages": saved, "damage": reader.damage}
    write_json(options.json, content)
    return 0
