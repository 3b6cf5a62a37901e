"""``dopslam replay``: a bag filtered offline."""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path
from typing import Any

from dopslam_ros.cli.options import add_json, add_settings, read_settings, write_json
from dopslam_ros.cli.progress import with_progress
from dopslam_ros.cli.run_summary import print_summary
from dopslam_ros.system.stopping import Stop

TEXT = "filter a bag offline, as fast as it goes"
EXAMPLE = "dopslam replay bags/paper --json result.json --param gamma=1"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of the command."""
    parser.add_argument("bag", type=Path, help="folder of a bag, or an .mcap file")
    parser.add_argument("--out", type=Path, help="folder of a new bag with the results")
    parser.add_argument("--picture", type=Path, help="file (.png, .svg) of track, map and errors")
    parser.add_argument("--map", type=Path, metavar="F", help="file of a map to start with")
    parser.add_argument("--save-map", type=Path, metavar="F", help="file for the map at the end")
    add_settings(parser)
    add_json(parser)


def run(options: Any) -> int:
    """Filters until the bag ends or Ctrl-C comes."""
    from dopslam_ros.bag import BagReader, BagWriter
    from dopslam_ros.offline.replay import replay
    from dopslam_ros.system.storage import read_checkpoint, write_checkpoint

    reader = BagReader(options.bag)
    progress = partial(with_progress, total=None, description="replay")
    settings = read_settings(options)
    with Stop(keep=True) as stop:
        start_map = None if options.map is None else read_checkpoint(options.map.resolve())
        if options.out is None:
            done = replay(reader, settings, None, progress, start_map)
        else:
            with BagWriter(options.out, flush_seconds=None) as writer:
                done = replay(reader, settings, writer, progress, start_map)
        if options.save_map is not None and done.known_map is not None:
            write_checkpoint(options.save_map, done.known_map)
        summary = done.summary()
        summary["stopped"] = stop.asked
        print_summary(summary)
        write_json(options.json, summary)
        if options.picture is not None:
            from dopslam_ros.lab.figures.run import draw_run

            draw_run(done, options.picture, str(options.bag))
    return stop.code()
