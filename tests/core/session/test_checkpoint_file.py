"""Maps and snapshots as bytes: whole round trips, every flip refused, nothing hostile taken."""

from __future__ import annotations

import hashlib
import json
import struct
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from dopslam_ros.core.pmb import FilterParameters
from dopslam_ros.core.pmb.inactive_grid import InactiveGrid
from dopslam_ros.core.session.checkpoint import MAP, SNAPSHOT, Checkpoint, CheckpointError
from dopslam_ros.core.session.checkpoint_file import MOST_BYTES, VERSION, decode, to_bytes
from dopslam_ros.core.session.filtering import FilterSession
from dopslam_ros.core.settings.layout import VEHICLE
from dopslam_ros.simulation.matched import filter_parameters_for
from dopslam_ros.simulation.scenario import load_scenario
from dopslam_ros.simulation.simulator import simulate

PREFIX = struct.Struct("<8sIIQ")
START = PREFIX.size + 32


def session_after(scene: str, steps: int, **settings: object) -> FilterSession:
    scenario = load_scenario(scene)
    scenario = replace(scenario, controls=scenario.controls[:steps])
    filtering = FilterSession(filter_parameters_for(scenario, **settings))
    for s in simulate(scenario, np.random.default_rng(2)):
        list(filtering.add_control(s.stamp_ns, s.control.speed, s.control.turn_rate))
        list(filtering.add_measurements(s.stamp_ns, s.measurements))
    return filtering


def signed(header: Any, payload: bytes, version: int = VERSION) -> bytes:
    """A file whose checksum is right, whatever is in it."""
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    prefix = PREFIX.pack(b"DOPSTATE", version, len(text), len(payload))
    return prefix + hashlib.sha256(prefix + text + payload).digest() + text + payload


def parts(data: bytes) -> tuple[dict[str, Any], bytes]:
    size = PREFIX.unpack_from(data)[2]
    return json.loads(data[START : START + size]), data[START + size :]


@pytest.fixture(scope="module")
def paper() -> Checkpoint:
    """A snapshot of the paper's scene, with landmarks inactive."""
    saved = session_after("paper", 20).snapshot()
    assert len(saved.posterior.inactive[0]) > 0
    return saved


@pytest.mark.parametrize(
    ("scene", "steps", "settings"),
    [
        ("paper", 20, {}),
        ("paper", 0, {}),
        ("paper", 12, {"density": "pmbm"}),
        ("paper", 12, {"coupling": "marginal", "measurement_noise_std": (0.1,) * 5 + (np.nan,)}),
        ("street_grid", 60, {}),
    ],
)
def test_everything_comes_back(scene: str, steps: int, settings: dict[str, Any]) -> None:
    filtering = session_after(scene, steps, **settings)
    for saved in (filtering.snapshot(), filtering.known_map()):
        again = decode(to_bytes(saved))
        assert to_bytes(again) == to_bytes(saved)
        assert (again.kind, again.stamp_ns) == (saved.kind, saved.stamp_ns)
        assert (again.controls, again.owed) == (saved.controls, saved.owed)
        ours, theirs = again.posterior, saved.posterior
        for one, other in zip(ours.densities, theirs.densities, strict=True):
            np.testing.assert_array_equal(one.mean, other.mean)
            np.testing.assert_array_equal(one.covariance, other.covariance)
            np.testing.assert_array_equal(one.track_id, other.track_id)
        for grid, expected in zip(ours.inactive, theirs.inactive, strict=True):
            assert list(grid.cells) == list(expected.cells)
            for cell, same in zip(grid.cells.values(), expected.cells.values(), strict=True):
                np.testing.assert_array_equal(cell.track_id, same.track_id)
                np.testing.assert_array_equal(cell.gain, same.gain)
                assert cell.gain.flags.c_contiguous and cell.gain.flags.writeable
        again.check(saved.kind, filtering.parameters)


def test_every_flipped_bit_is_refused(paper: Checkpoint) -> None:
    data = bytearray(to_bytes(paper))
    for place in range(len(data)):
        for bit in (1, 128) if place > 200 else (1, 2, 4, 8, 16, 32, 64, 128):
            data[place] ^= bit
            with pytest.raises(CheckpointError):
                decode(bytes(data))
            data[place] ^= bit
    assert to_bytes(decode(bytes(data))) == bytes(data)


def test_every_cut_and_every_addition_is_refused(paper: Checkpoint) -> None:
    data = to_bytes(paper)
    for size in [*range(0, 300), *range(300, len(data), 97)]:
        with pytest.raises(CheckpointError, match=r"cut off|no map or snapshot"):
            decode(data[:size])
    with pytest.raises(CheckpointError, match="not as it says"):
        decode(data + b"\0")


def test_flips_with_a_right_checksum_are_refused_or_make_a_sound_state(paper: Checkpoint) -> None:
    """Somebody who can count can also sign: nothing but CheckpointError may come of it."""
    header, payload = parts(to_bytes(paper))
    text = json.dumps(header).encode()
    rng = np.random.default_rng(11)
    taken = 0
    for turn in range(3000):
        spoilt_text, spoilt = bytearray(text), bytearray(payload)
        for _ in range(int(rng.integers(1, 4))):
            target = spoilt_text if turn % 3 == 0 else spoilt
            target[int(rng.integers(len(target)))] ^= 1 << int(rng.integers(8))
        try:
            saved = decode(signed(bytes(spoilt_text), bytes(spoilt)))
        except CheckpointError:
            continue
        taken += 1
        for state in saved.posterior.densities:
            assert np.isfinite(state.mean).all() and np.isfinite(state.covariance).all()
            assert np.linalg.eigvalsh(state.covariance).min() > -1e-3
    assert 0 < taken < 3000


Change = Callable[[dict[str, Any]], object]


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda h: h["arrays"][4][2].__setitem__(0, 2**60), "side of"),
        (lambda h: h["arrays"][4][2].__setitem__(0, -1), "side of"),
        (lambda h: h["arrays"].append(["more", "<f8", [MOST_BYTES]]), "does not fit"),
        (lambda h: h["arrays"].append(["more", "<f8", [MOST_BYTES] * 40]), "does not fit"),
        (lambda h: h["arrays"].append(["more", "O", [0]]), "no sense"),
        (lambda h: h["arrays"].append(h["arrays"][0]), "does not fit"),
        (lambda h: h["arrays"].append(["more", "<f8", [0]]), "of no use"),
        (lambda h: h.pop("arrays"), "no sense"),
        (lambda h: h.update(arrays={}), "of no array"),
        (lambda h: h.update(kind="virus"), "kind"),
        (lambda h: h.update(stamp_ns=2**70), "stamp"),
        (lambda h: h.update(parameters=[1]), "no sense"),
        (lambda h: h["parameters"].update(sp_field_of_view=3.0), "elsewhere"),
        (lambda h: h["parameters"].update(sp_field_of_view=float("nan")), "no sense|elsewhere"),
    ],
)
def test_a_hostile_header_is_refused(paper: Checkpoint, change: Change, match: str) -> None:
    header, payload = parts(to_bytes(paper))
    change(header)
    with pytest.raises(CheckpointError, match=match):
        decode(signed(header, payload))


@pytest.mark.parametrize("text", [b"[" * 100_000, b"", b"\xff", b"{}", b"[]", b"1e999", b"nul"])
def test_a_header_that_is_no_header_is_refused(text: bytes) -> None:
    with pytest.raises(CheckpointError, match="no sense"):
        decode(signed(text, b""))


def test_another_version_and_other_files_are_refused(paper: Checkpoint) -> None:
    header, payload = parts(to_bytes(paper))
    with pytest.raises(CheckpointError, match=f"version {VERSION + 1}"):
        decode(signed(header, payload, VERSION + 1))
    for data in (b"", b"hello", b"\x89MCAP0\r\n" + bytes(100)):
        with pytest.raises(CheckpointError, match="no map or snapshot"):
            decode(data)


def spoil(saved: Checkpoint, **changes: Any) -> Checkpoint:
    spoilt = (saved.posterior.density.but(**changes),)
    return replace(saved, posterior=replace(saved.posterior, densities=spoilt))


def test_what_is_no_density_is_refused(paper: Checkpoint) -> None:
    best = paper.posterior.density
    mean, covariance = best.mean.copy(), best.covariance.copy()
    mean[5] = np.nan
    skew, negative = covariance.copy(), covariance.copy()
    skew[0, 1] += 1.0
    negative[[0, 1], [1, 0]] = 1.5 * np.sqrt(covariance[0, 0] * covariance[1, 1])
    mirrored = -best.axes
    nearer = InactiveGrid(paper.posterior.inactive[0].cells, 0.0)
    spoilt = {
        "mean": spoil(paper, mean=mean),
        "symmetric": spoil(paper, covariance=skew),
        "no covariance": spoil(paper, covariance=negative),
        "shape": spoil(paper, origin=best.origin[1:]),
        "gaps": spoil(paper, component_track=best.component_track + 1),
        "unknown": spoil(paper, component_type=best.component_type * 0),
        "probability": spoil(paper, existence=best.existence + 1.0),
        "sum to 1": spoil(paper, component_weight=best.component_weight * 0.5),
        "right angles": spoil(paper, axes=best.axes * 1.01),
        "same id": spoil(paper, track_id=best.track_id * 0 + 1),
        "id is out of range": spoil(paper, next_id=1),
        "a reactivation distance": replace(
            paper, posterior=replace(paper.posterior, inactive=(nearer,))
        ),
        "no vehicle": replace(paper, kind=MAP),
        "where none can be": replace(paper, known=paper),
        "in order": replace(paper, controls=paper.controls * 2),
    }
    for match, saved in spoilt.items():
        with pytest.raises(CheckpointError, match=match):
            decode(to_bytes(saved))
    decode(to_bytes(spoil(paper, axes=mirrored)))  # handedness is of no matter to a frame


def test_another_filter_refuses_it(paper: Checkpoint) -> None:
    parameters = filter_parameters_for(load_scenario("paper"))
    saved = decode(to_bytes(paper))
    saved.check(SNAPSHOT, parameters)
    with pytest.raises(CheckpointError, match="give a map"):
        saved.check(MAP, parameters)
    others: dict[str, FilterParameters] = {
        "bs_position": replace(parameters, bs_position=(0.0, 0.0, 41.0)),
        "ue_height": replace(parameters, ue_height=1.5),
        "sp_field_of_view": replace(parameters, sp_field_of_view=40.0),
        "coupling": replace(parameters, coupling="marginal"),
        "density": replace(parameters, density="pmbm"),
        "mapping": replace(parameters, mapping=False),
    }
    for name, other in others.items():
        with pytest.raises(CheckpointError, match=name):
            saved.check(SNAPSHOT, other)
    known = session_after("paper", 20).known_map()
    assert not known.posterior.density.mean[: len(VEHICLE)].any()
    for name, other in others.items():
        if name in ("coupling", "density", "mapping"):
            known.check(MAP, other)
        else:
            with pytest.raises(CheckpointError, match=name):
                known.check(MAP, other)
