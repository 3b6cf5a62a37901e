"""Twenty thousand messages that cannot be used, among those of a run: none leaves a trace.

They go through what the node and the replay use: bytes, message, arrays, session.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from dopslam_ros.bag import deserialize, message_class, record_type, serialize
from dopslam_ros.core.models.measurements import MOST_PATHS, MeasurementSet
from dopslam_ros.core.models.refusal import Refused
from dopslam_ros.core.session.filtering import FilterSession
from dopslam_ros.core.session.ordering import UNCONFIRMED
from dopslam_ros.core.session.output import FilterOutput
from dopslam_ros.messages import topics
from dopslam_ros.messages.common import Frames, read_message, stamp_ns
from dopslam_ros.messages.inputs import (
    make_control,
    make_measurements,
    read_control,
    read_measurements,
)
from dopslam_ros.simulation.matched import filter_parameters_for
from dopslam_ros.simulation.scenario import load_scenario
from dopslam_ros.simulation.simulator import simulate

SETS, CONTROLS = topics.CHANNEL_MEASUREMENTS, topics.ODOMETRY_CONTROL
SCENARIO = load_scenario("paper")
PARAMETERS = filter_parameters_for(SCENARIO)
COUNT = 20_000
PATH = "dopslam_msgs/msg/ChannelMeasurement"
# Numbers that no sensor means.
ODD = [math.inf, -math.inf, 1e300, -1e300, 1e12, -1e12]

Spoil = Callable[[Any, np.random.Generator], object]


def take(filtering: FilterSession, topic: topics.Topic, payload: bytes) -> list[FilterOutput]:
    """What the node does with the bytes of a message."""
    message = read_message(payload, topic)
    stamp = stamp_ns(message.header)
    if topic == CONTROLS:
        return list(filtering.add_control(stamp, *read_control(message)))
    return list(filtering.add_measurements(stamp, read_measurements(message)))


@pytest.fixture(scope="module")
def good() -> list[tuple[topics.Topic, bytes]]:
    """The inputs of a run."""
    frames, inputs = Frames(), []
    for snapshot in simulate(SCENARIO, np.random.default_rng(8)):
        stamp = snapshot.stamp_ns
        for topic, message in (
            (CONTROLS, make_control(message_class, stamp, snapshot.control, frames)),
            (SETS, make_measurements(message_class, stamp, snapshot.measurements, frames)),
        ):
            inputs.append((topic, serialize(message, topic.type_name)))
    return inputs


# --- ways to spoil a message ---------------------------------------------------------------------


def a_path(message: Any, rng: np.random.Generator) -> Any:
    return message.paths[rng.integers(len(message.paths))]


def a_component(rng: np.random.Generator) -> str:
    return str(
        rng.choice(["path_length", "aoa_azimuth", "aoa_elevation", "aod_azimuth", "doppler"])
    )


def odd_value(message: Any, rng: np.random.Generator) -> None:
    setattr(a_path(message, rng), a_component(rng), float(rng.choice(ODD)))


def nothing_measured(message: Any, rng: np.random.Generator) -> None:
    path = a_path(message, rng)
    for name in ("path_length", "doppler"):
        setattr(path, name, math.nan)
    for end in ("aoa", "aod"):
        setattr(path, f"{end}_azimuth", math.nan)
        setattr(path, f"{end}_elevation", math.nan)


def covariance_of(change: Callable[[np.ndarray, np.random.Generator], object]) -> Spoil:
    def spoil(message: Any, rng: np.random.Generator) -> None:
        matrix = np.diag([0.01, 2.5e-3, 2.5e-3, 2.5e-3, 2.5e-3, 0.01])
        change(matrix, rng)
        a_path(message, rng).covariance = matrix.ravel()

    return spoil


def not_finite(matrix: np.ndarray, rng: np.random.Generator) -> None:
    matrix[tuple(rng.integers(6, size=2))] = rng.choice([math.nan, math.inf, -math.inf])


def negative(matrix: np.ndarray, rng: np.random.Generator) -> None:
    matrix[(rng.integers(6),) * 2] *= -1.0


def absurd(matrix: np.ndarray, rng: np.random.Generator) -> None:
    matrix[(rng.integers(6),) * 2] = rng.choice([1e-300, 1e300, 1e-30, 1e30])


def asymmetric(matrix: np.ndarray, rng: np.random.Generator) -> None:
    i, j = rng.choice(6, 2, replace=False)
    matrix[i, j] = 0.5 * math.sqrt(matrix[i, i] * matrix[j, j])


def over_correlated(matrix: np.ndarray, rng: np.random.Generator) -> None:
    i, j = rng.choice(6, 2, replace=False)
    matrix[i, j] = matrix[j, i] = rng.uniform(1.001, 9.0) * math.sqrt(matrix[i, i] * matrix[j, j])


def too_many(message: Any, rng: np.random.Generator) -> None:
    paths = np.zeros(MOST_PATHS + 1 + rng.integers(50), record_type(PATH))
    paths["path_length"] = 400.0
    message.paths = paths


def stamped(sec: int, nanosec: int) -> Spoil:
    def spoil(message: Any, rng: np.random.Generator) -> None:
        message.header.stamp.sec, message.header.stamp.nanosec = sec, nanosec

    return spoil


def not_a_speed(message: Any, rng: np.random.Generator) -> None:
    part, axis = ("linear", "x") if rng.random() < 0.5 else ("angular", "z")
    setattr(getattr(message.twist, part), axis, float(rng.choice([math.nan, *ODD])))


STAMPS = [stamped(0, 0), stamped(-5, 3), stamped(3, 2_000_000_000), stamped(-(2**31), 7)]
OF_SETS: list[Spoil] = [
    odd_value,
    nothing_measured,
    *map(covariance_of, (not_finite, negative, absurd, asymmetric, over_correlated)),
    *STAMPS,
]
OF_CONTROLS: list[Spoil] = [not_a_speed, not_a_speed, *STAMPS]


def spoilt(
    topic: topics.Topic, payload: bytes, after_ns: int, rng: np.random.Generator
) -> bytes | None:
    """A message that would be next in time, if it could be used."""
    message: Any = deserialize(payload, topic.type_name)
    time = after_ns + int(rng.integers(1, 400_000_000))
    stamped(time // 10**9, time % 10**9)(message, rng)
    if topic == SETS and not len(message.paths):
        return None
    ways = OF_SETS if topic == SETS else OF_CONTROLS
    if topic == SETS and rng.random() < 1e-3:
        too_many(message, rng)
    else:
        ways[rng.integers(len(ways))](message, rng)
    return serialize(message, topic.type_name)


def cut(payload: bytes, rng: np.random.Generator) -> bytes:
    """The beginning of a message, or one that says it has a billion paths."""
    if rng.random() < 0.5:
        return payload[: rng.integers(len(payload))]
    at = 4 * int(rng.integers(1, min(len(payload) // 4, 9)))
    return payload[:at] + bytes([255, 255, 255, 127]) + payload[at + 4 :]


def test_messages_that_cannot_be_used_leave_no_trace(
    good: list[tuple[topics.Topic, bytes]],
) -> None:
    rng = np.random.default_rng(20_000)
    clean, troubled = FilterSession(PARAMETERS), FilterSession(PARAMETERS)
    reasons: Counter[str] = Counter()
    each = COUNT // len(good) + 1
    for topic, payload in good:
        expected, found = take(clean, topic, payload), take(troubled, topic, payload)
        assert [o.state.density.mean.tobytes() for o in found] == [
            o.state.density.mean.tobytes() for o in expected
        ]
        time = stamp_ns(deserialize(payload, topic.type_name).header)
        for _ in range(each):
            bad = spoilt(topic, payload, time, rng)
            if bad is None:
                continue
            with pytest.raises(Refused) as caught:
                take(troubled, topic, bad)
            reasons[caught.value.reason] += 1
            assert len(str(caught.value)) > 20
        for again in (payload, cut(payload, rng)):  # the same once more, and pieces
            try:
                assert take(troubled, topic, again) == []
            except Refused as error:
                reasons[error.reason] += 1
    assert reasons.total() >= COUNT - each
    assert {"implausible_value", "duplicate_stamp", "malformed_message", "no_stamp"} <= set(reasons)
    assert {"invalid_control", "too_many_paths", "covariance_not_finite"} <= set(reasons)
    assert set(troubled.problems) <= {UNCONFIRMED}
    assert troubled.state.density.covariance.tobytes() == clean.state.density.covariance.tobytes()
    assert troubled.state.density.existence.tobytes() == clean.state.density.existence.tobytes()


@pytest.mark.parametrize("seed", range(3))
def test_garbled_bytes_are_refused_or_give_numbers(
    good: list[tuple[topics.Topic, bytes]], seed: int
) -> None:
    """Flipped bytes may still make a message; then what comes out is finite and a covariance."""
    rng = np.random.default_rng(seed)
    filtering = FilterSession(PARAMETERS)
    outputs: list[FilterOutput] = []
    for _ in range(25):
        for topic, payload in good:
            garbled = bytearray(payload)
            for at in rng.integers(4, len(garbled), rng.integers(0, 4)):
                garbled[at] = rng.integers(256)
            try:
                outputs += take(filtering, topic, bytes(garbled))
            except Refused:
                continue
    assert outputs
    for output in outputs:
        check_numbers(output)


def senseless(rng: np.random.Generator) -> MeasurementSet:
    """Paths that are allowed and make no sense: any size, any accuracy, parts missing."""
    count = int(rng.integers(1, 12))
    values = np.array([1e7, 6.2, 3.1, 6.2, 3.1, 1e5]) * rng.choice(
        [-1.0, 1.0, 0.0, 1e-300, 0.3], size=(count, 6)
    )
    values[rng.random(values.shape) < 0.3] = np.nan
    values[np.isnan(values).all(axis=1), 0] = 0.0
    variances = 10.0 ** rng.uniform(-17.9, 17.9, size=(count, 6))
    return MeasurementSet(values, variances[:, :, None] * np.eye(6))


def test_senseless_sets_that_are_allowed_give_numbers(
    good: list[tuple[topics.Topic, bytes]],
) -> None:
    rng = np.random.default_rng(17)
    filtering = FilterSession(PARAMETERS)
    for topic, payload in good:
        if topic == SETS:
            time = stamp_ns(deserialize(payload, topic.type_name).header)
            message = make_measurements(message_class, time, senseless(rng), Frames())
            payload = serialize(message, topic.type_name)
        for output in take(filtering, topic, payload):
            check_numbers(output)
    assert not filtering.problems


def test_ten_thousand_paths_are_not_even_read(good: list[tuple[topics.Topic, bytes]]) -> None:
    message: Any = deserialize(good[1][1], SETS.type_name)
    message.paths = np.ones(10_000, record_type(PATH))
    with pytest.raises(Refused) as caught:
        read_message(serialize(message, SETS.type_name), SETS)
    assert caught.value.reason == "message_too_large" and str(MOST_PATHS) in str(caught.value)


def check_numbers(output: FilterOutput) -> None:
    """All is finite, and the covariance is one."""
    best = output.state.density
    assert np.isfinite(best.mean).all() and np.isfinite(best.existence).all()
    scale = np.sqrt(np.diagonal(best.covariance))
    correlation = best.covariance / np.outer(scale, scale)
    np.testing.assert_allclose(correlation, correlation.T, rtol=0.0, atol=1e-12)
    assert np.linalg.eigvalsh(correlation)[0] > 0.0
