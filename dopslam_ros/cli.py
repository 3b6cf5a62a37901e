# PYTHON_ARGCOMPLETE_OK
"""The ``dopslam`` command."""

from __future__ import annotations

import argparse
import difflib
import math
import os
import re
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, NoReturn

import numpy as np
from tqdm import tqdm

from dopslam_ros import __version__, mapinfo, watch
from dopslam_ros.bag import BagError, BagReader, BagWriter
from dopslam_ros.bag.repair import free_name, repair
from dopslam_ros.bench import command as bench
from dopslam_ros.core.evaluation import StepRecord, summarise
from dopslam_ros.core.model import with_doppler_std
from dopslam_ros.core.parameters import ParameterError, commented_yaml, shared_values
from dopslam_ros.core.scenario import ScenarioError, load_scenario
from dopslam_ros.core.study import nominal_bounds
from dopslam_ros.files import write_whole
from dopslam_ros.options import (
    Stop,
    UsageError,
    add_json,
    add_quiet,
    add_scenario,
    add_settings,
    check_files,
    nearest_file,
    positive_number,
    read_settings,
    silence,
    whole_from_zero,
    with_progress,
    write_json,
)
from dopslam_ros.published import published
from dopslam_ros.report import command as reporting
from dopslam_ros.storage import read_saved, write_saved
from dopslam_ros.study import command as study
from dopslam_ros.study import trouble_command as trouble
from dopslam_ros.study.results import load_results

SIGMAS = (0.05, 0.1, 0.2, 0.3, 0.4, 0.5)

EXAMPLES = {
    "demo": "dopslam demo --rate 5",
    "simulate": "dopslam simulate --scenario paper --seed 7 --out runs/sim7",
    "replay": "dopslam replay bags/paper --json result.json --param gamma=1",
    "report": "dopslam report bags/paper --out paper.html",
    "map": "dopslam map ~/.ros/dopslam/hall.dopmap",
    "compare": "dopslam compare bags/paper bags/paper:doppler=none --out doppler.html",
    "bounds": "dopslam bounds --sigma-d 0.1 0.5",
    "study": "dopslam study --filters joint marginal --doppler 0.1 none --out runs/study",
    "trouble": "dopslam trouble --runs 200 --seed 12345 --json trouble.json",
    "figures": "dopslam figures runs/study --out runs/figures",
    "bench": "dopslam bench --json bench.json --markdown BENCHMARKS.md",
    "parameters": "dopslam parameters filter > config/filter.yaml",
    "recover": "dopslam recover runs/cut_off",
    "watch": "dopslam watch bags/paper --rate 5",
}


ENDING = """exit codes:
  0    it was done
  1    it failed: a file cannot be read or written, or results differ that should not
  2    it was asked wrongly: an option, a name or a value
  130  Ctrl-C ended it; what was done by then is kept

completion in bash, also for this session alone:
  eval "$(register-python-argcomplete dopslam)"
"""
# Commands whose output is all that they are for.
TALKERS = ("parameters", "watch")


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
            return int(options.run(options))
    except (UsageError, ScenarioError, ParameterError) as error:
        _complain(error)
        return 2
    except BrokenPipeError:  # whoever read our output has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except (BagError, OSError, ValueError, RuntimeError) as error:
        _complain(error, nearest_file(options))
        return 1
    except KeyboardInterrupt:
        print("dopslam: stopped", file=sys.stderr)
        return 130


def _complain(error: Exception, hint: str = "") -> None:
    """One line, also where a library's message has several."""
    print("dopslam:", " ".join(f"{error}{hint}".split()), file=sys.stderr)


class _Parser(argparse.ArgumentParser):
    """Where a name is wrong it says the nearest one that is right."""

    words: ClassVar[set[str]] = {*EXAMPLES}

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
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    def command(name: str, run: Callable[[Any], int], text: str) -> argparse.ArgumentParser:
        sub = commands.add_parser(
            name,
            help=text,
            description=text,
            epilog=f"example:\n  {EXAMPLES[name]}",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        sub.set_defaults(run=run)
        if name not in TALKERS:
            add_quiet(sub)
        return sub

    sub = command("demo", _demo, "run the paper's scene live, record, replay, compare, draw")
    add_scenario(sub, "paper")
    sub.add_argument("--seed", type=whole_from_zero, help="of the run (default: the scenario's)")
    sub.add_argument(
        "--rate", type=positive_number, default=10.0, help="times real time (default: 10)"
    )
    sub.add_argument("--out", type=Path, default=Path("runs"), help="parent folder of the results")

    sub = command("simulate", _simulate, "write a simulated run into a bag")
    add_scenario(sub, "paper")
    sub.add_argument("--seed", type=whole_from_zero, help="of the run (default: the scenario's)")
    sub.add_argument("--out", type=Path, required=True, help="folder of the new bag")
    add_json(sub)

    sub = command("replay", _replay, "filter a bag offline, as fast as it goes")
    sub.add_argument("bag", type=Path, help="folder of a bag, or an .mcap file")
    sub.add_argument("--out", type=Path, help="folder of a new bag with the results")
    sub.add_argument("--picture", type=Path, help="file (.png, .svg) of track, map and errors")
    sub.add_argument("--map", type=Path, metavar="F", help="file of a map to start with")
    sub.add_argument("--save-map", type=Path, metavar="F", help="file for the map at the end")
    add_settings(sub)
    add_json(sub)

    sub = command("map", mapinfo.run, "what is in a saved map or snapshot")
    sub.add_argument("file", type=Path, help="a file that save_map, replay or a filter left")
    add_json(sub)

    sub = command("report", reporting.report, "a run as one page for the browser, map over time")
    reporting.add_report_arguments(sub)

    sub = command("compare", reporting.compare, "runs, or one run set in several ways, in numbers")
    reporting.add_compare_arguments(sub)

    sub = command("bounds", _bounds, "error bounds at the last step, for several Doppler noises")
    add_scenario(sub, "paper_bounds")
    sub.add_argument(
        "--sigma-d",
        type=positive_number,
        nargs="+",
        default=SIGMAS,
        metavar="M/S",
        help="standard deviations of the Doppler [m/s]; without Doppler is always added",
    )
    add_json(sub)

    sub = command("study", study.run, "Monte Carlo: filters beside each other and their bound")
    study.add_arguments(sub)

    sub = command("trouble", trouble.run, "Monte Carlo: a vehicle gets lost, and is it found again")
    trouble.add_arguments(sub)

    sub = command("figures", _figures, "draw a study beside the paper's figures, with their ratios")
    sub.add_argument("study", type=Path, help="folder of a study")
    sub.add_argument("--out", type=Path, required=True, help="folder of the pictures and tables")

    sub = command("bench", bench.run, "measure speed and memory, beside what they compare with")
    bench.add_arguments(sub)

    sub = command("parameters", _parameters, "the parameters of a node as a commented YAML file")
    sub.add_argument("node", choices=sorted(NODES), help="which node")
    sub.add_argument(
        "--scenario", help="take what it has of the models: a YAML file or a scene's name"
    )

    sub = command("recover", _recover, "save what can be read of a damaged bag into a new one")
    sub.add_argument("old", type=Path, help="folder of a bag, or an .mcap file; stays as it is")
    sub.add_argument(
        "new", type=Path, nargs="?", help="folder of the new bag (default: OLD_recovered)"
    )
    add_json(sub)

    sub = command(
        "watch", watch.run, "pose, map, rates and health in the terminal, live or a bag's"
    )
    watch.add_arguments(sub)
    return parser


# --- commands ------------------------------------------------------------------------------------


def _demo(options: Any) -> int:
    from dopslam_ros.demo import new_folder, replay_and_compare, run_live
    from dopslam_ros.figures.run import draw_run
    from dopslam_ros.report.recorded import last_reports
    from dopslam_ros.report.run_page import run_page

    scenario = load_scenario(options.scenario)
    seed = scenario.seed if options.seed is None else options.seed
    folder = new_folder(options.out, scenario)
    print(f"scene '{scenario.name}', seed {seed}, {options.rate:g} times real time -> {folder}")
    with tqdm(total=scenario.steps, desc="live", unit="step") as bar:

        def show(done: int) -> None:
            if done > bar.n:
                bar.update(done - bar.n)

        bag = run_live(options.scenario, seed, options.rate, folder, show)
    run, different = replay_and_compare(bag, folder / "replay")
    summary = _summary(run)
    write_json(folder / "result.json", summary)
    print(f"live run recorded in {bag}, replayed into {folder / 'replay'}")
    print(f"replay against live: {different or 'all vehicle states equal, byte for byte'}")
    _print_summary(summary)
    picture = folder / "run.png"
    draw_run(run, picture, f"{scenario.name}, seed {seed}")
    print(f"picture: {picture}")
    page = folder / "report.html"
    write_whole(page, run_page(run, str(bag), last_reports(BagReader(bag))).encode("utf-8"))
    print(f"the map over time: open {page} in a browser")
    return 1 if different else 0


def _simulate(options: Any) -> int:
    from dopslam_ros.simulation import write_simulation

    scenario = load_scenario(options.scenario)
    seed = scenario.seed if options.seed is None else options.seed
    stop = Stop()
    with BagWriter(options.out, flush_seconds=None) as writer:
        progress = partial(with_progress, total=scenario.steps, description="simulate", stop=stop)
        count = write_simulation(scenario, seed, writer, progress)
    content = {"scenario": scenario.name, "seed": seed, "snapshots": count}
    write_json(options.json, {**content, "bag": str(options.out), "stopped": stop.asked})
    print(f"{count} snapshots of scene '{scenario.name}', seed {seed}, in {options.out}")
    return stop.code()


def _replay(options: Any) -> int:
    from dopslam_ros.figures.run import draw_run
    from dopslam_ros.replay import replay

    reader = BagReader(options.bag)
    stop = Stop()
    progress = partial(with_progress, total=None, description="replay", stop=stop)
    settings = read_settings(options)
    start_map = None if options.map is None else read_saved(options.map.resolve())
    if options.out is None:
        run = replay(reader, settings, None, progress, start_map)
    else:
        with BagWriter(options.out, flush_seconds=None) as writer:
            run = replay(reader, settings, writer, progress, start_map)
    if options.save_map is not None and run.known_map is not None:
        write_saved(options.save_map, run.known_map)
    summary = _summary(run)
    summary["stopped"] = stop.asked
    _print_summary(summary)
    write_json(options.json, summary)
    if options.picture is not None:
        draw_run(run, options.picture, str(options.bag))
    return stop.code()


def _bounds(options: Any) -> int:
    scenario = load_scenario(options.scenario)
    rows = []
    for sigma in (*options.sigma_d, None):
        bound = nominal_bounds(with_doppler_std(scenario, sigma))
        rows.append(
            {
                "sigma_d": sigma,
                "peb": bound.peb,
                "heb_deg": math.degrees(bound.heb),
                "ceb": bound.ceb,
                "leb_mean": float(np.mean(bound.leb)) if len(bound.leb) else math.nan,
            }
        )
    write_json(options.json, {"rows": rows})
    print("bounds at the last step; in brackets, ours over the paper's")
    print(f"{'sigma_d':>9} {'PEB [m]':>16} {'HEB [deg]':>16} {'CEB [m]':>16} {'mean LEB [m]':>16}")
    for row in rows:
        sigma = row["sigma_d"]
        theirs = published().bounds_at(sigma) if scenario.name == "paper_bounds" else None
        cells = [row[key] for key in ("peb", "heb_deg", "ceb", "leb_mean")]
        texts = [
            f"{ours:.4f}" + ("" if theirs is None else f" ({ours / theirs[n]:.3f})")
            for n, ours in enumerate(cells)
        ]
        name = "without" if sigma is None else f"{sigma:g} m/s"
        print(f"{name:>9} " + " ".join(f"{text:>16}" for text in texts))
    return 0


def _figures(options: Any) -> int:
    from dopslam_ros.figures.paper import draw_study, missing
    from dopslam_ros.figures.ratios import write_ratios

    results = load_results(options.study)
    options.out.mkdir(parents=True, exist_ok=True)
    names = draw_study(results, options.out)
    write_ratios(results, options.out)
    print(f"in {options.out}: {', '.join(names)} (.png, .svg); ratios (.md, .csv, .json)")
    for text in missing(results):
        print(f"missing: {text}")
    return 0


def _parameters(options: Any) -> int:
    import importlib

    module, name = NODES[options.node]
    kind = getattr(importlib.import_module(module), name)
    values, origin = {}, "their defaults"
    if options.scenario is not None:
        scenario = load_scenario(options.scenario)
        values, origin = shared_values(scenario, kind), f"the models of scene '{scenario.name}'"
    print(f"# Parameters of the {options.node} node with {origin}.")
    print(commented_yaml(kind(**values), ros=True), end="")
    return 0


def _recover(options: Any) -> int:
    new = options.new or free_name(options.old)
    reader = repair(options.old, new)
    saved = BagReader(new).message_count
    print(f"{saved} messages of {options.old} are in {new}")
    if reader.damage:
        print(f"missing: {reader.damage}")
    content = {"bag": str(new), "messages": saved, "damage": reader.damage}
    write_json(options.json, content)
    return 0


NODES = {
    node: (f"dopslam_ros.nodes.{node}", name)
    for node, name in (
        ("simulator", "SimulatorParameters"),
        ("filter", "FilterNodeParameters"),
        ("bounds", "BoundsNodeParameters"),
        ("recorder", "RecorderParameters"),
        ("player", "PlayerParameters"),
    )
}


# --- pieces --------------------------------------------------------------------------------------


def _summary(run: Any) -> dict[str, Any]:
    """The JSON of a replay."""
    records: list[StepRecord] = run.records()
    summary = summarise(records)
    summary["problems"] = dict(sorted(run.problems.items()))
    if run.damage:
        summary["damage"] = run.damage
    return summary


def _print_summary(summary: dict[str, Any]) -> None:
    """A small table; what is not known is not shown."""
    rows = (
        ("position [m]", "position_rmse", "bound_position_rms"),
        ("heading [deg]", "heading_rmse_deg", "bound_heading_rms_deg"),
        ("clock bias [m]", "clock_bias_rmse", "bound_clock_rms"),
    )
    if any(key in summary for _, key, _ in rows):
        print(f"{'':18}{'RMSE':>10}{'bound':>10}{'ratio':>8}")
    for label, ours, bound in rows:
        if ours in summary:
            line = f"{label:18}{summary[ours]:10.4f}"
            if bound in summary:
                line += f"{summary[bound]:10.4f}{summary[ours] / summary[bound]:8.2f}"
            print(line)
    for label, key in (("GOSPA of VAs [m]", "gospa_va"), ("GOSPA of SPs [m]", "gospa_sp")):
        if key in summary:
            last = np.mean(summary[key][-10:])
            print(f"{label:18}{last:10.2f}   mean of the last {len(summary[key][-10:])} steps")
    if "nees_mean" in summary:
        print(f"{'NEES':18}{summary['nees_mean']:10.2f}   4 where the covariance is honest")
    if "step_ms_p50" in summary:
        print(
            f"{'step time [ms]':18}{summary['step_ms_p50']:10.2f}   median of {summary['steps']}"
            f" steps; 99 %: {summary['step_ms_p99']:.2f}"
        )
    for name, count in summary.get("problems", {}).items():
        print(f"problem: {name}: {count}")
    if "damage" in summary:
        print(f"damaged bag: {summary['damage']}")


if __name__ == "__main__":
    raise SystemExit(main())
