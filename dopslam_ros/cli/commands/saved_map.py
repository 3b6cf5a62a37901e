"""``dopslam map``: what is in a saved map or snapshot."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dopslam_ros.cli.options import add_json, write_json
from dopslam_ros.system.stopping import Stop

if TYPE_CHECKING:
    from dopslam_ros.core.pmb import FilterParameters
    from dopslam_ros.core.session.checkpoint import Checkpoint

TEXT = "what is in a saved map or snapshot"
EXAMPLE = "dopslam map ~/.ros/dopslam/hall.dopmap"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of the command."""
    parser.add_argument("file", type=Path, help="a file that save_map, replay or a filter left")
    add_json(parser)


def run(options: Any) -> int:
    """Reads the file and tells what is in it."""
    from dopslam_ros.system.storage import read_checkpoint

    with Stop():
        about = _describe(read_checkpoint(options.file.resolve()))
    write_json(options.json, about)
    _print(about)
    return 0


def _describe(saved: Checkpoint) -> dict[str, Any]:
    """Facts for JSON: what it is, of which filter, and its landmarks with their covariances."""
    import numpy as np

    from dopslam_ros.core.pmb.estimates import reported_landmarks
    from dopslam_ros.core.session.checkpoint import BEFORE_ALL, SNAPSHOT
    from dopslam_ros.core.session.checkpoint_file import VERSION
    from dopslam_ros.core.settings.layout import LandmarkType

    state, parameters = saved.posterior, _parameters(saved)
    everything = reported_landmarks(state, parameters)
    landmarks = [
        {
            "id": int(everything.ids[n]),
            "type": LandmarkType(int(everything.types[n])).name,
            "existence": float(everything.existence[n]),
            "position": everything.positions[n].tolist(),
            "covariance": everything.covariances[n].tolist(),
        }
        for n in range(len(everything.ids))
    ]
    vehicle = {
        "state": state.ue_mean.tolist(),
        "std": np.sqrt(np.diagonal(state.ue_covariance)).tolist(),
    }
    return {
        "kind": saved.kind,
        "version": VERSION,
        "checksum": "ok",
        "stamp_ns": None if saved.stamp_ns == BEFORE_ALL else saved.stamp_ns,
        "tracks": len(state.landmark_ids),
        "tracks_out_of_view": len(state.inactive[0]),
        "hypotheses": len(state.densities),
        "parameters": dict(saved.parameters),
        "landmarks": landmarks,
        **({"vehicle": vehicle} if saved.kind == SNAPSHOT else {}),
    }


def _print(about: dict[str, Any]) -> None:
    """The same as a small table."""
    stamp = about["stamp_ns"]
    when = "before the first set" if stamp is None else f"at {stamp * 1e-9:.3f} s"
    settings = about["parameters"]
    print(f"{about['kind']} {when}, version {about['version']}, checksum {about['checksum']}")
    print(
        f"base station {list(settings['bs_position'])} m, vehicle's antenna at"
        f" {settings['ue_height']:g} m, coupling {settings['coupling']}"
    )
    if "vehicle" in about:
        x, y, heading, bias = about["vehicle"]["state"]
        print(f"vehicle at {x:.2f}, {y:.2f} m, heading {heading:.4f} rad, clock bias {bias:.2f} m")
    print(
        f"{about['tracks']} landmarks, {about['tracks_out_of_view']} of them out of view;"
        f" {len(about['landmarks'])} sure enough to be reported:"
    )
    print(f"{'id':>5} {'type':4} {'exists':>7} {'x, y, z [m]':>28} {'standard deviations [m]':>26}")
    for one in about["landmarks"]:
        position = " ".join(f"{v:9.2f}" for v in one["position"])
        variances = (row[axis] for axis, row in enumerate(one["covariance"]))
        stds = " ".join(f"{math.sqrt(v):8.3f}" for v in variances)
        print(f"{one['id']:5} {one['type']:4} {one['existence']:7.4f} {position} {stds}")


def _parameters(saved: Checkpoint) -> FilterParameters:
    """Those of the filter that saved, as far as this version knows them."""
    from dopslam_ros.core.pmb import FilterParameters
    from dopslam_ros.core.settings.parameters import ParameterError, declarations, from_mapping

    known = {d.name for d in declarations(FilterParameters)}
    values = {name: value for name, value in saved.parameters.items() if name in known}
    try:
        return from_mapping(FilterParameters, values)
    except ParameterError:
        return FilterParameters()
