"""Sets and controls as messages: nothing is lost."""

from __future__ import annotations

import numpy as np

from dopslam_ros.bag import deserialize, message_class, serialize
from dopslam_ros.core.models.measurements import MeasurementSet
from dopslam_ros.core.models.motion import Control
from dopslam_ros.core.settings.layout import BS_ID
from dopslam_ros.messages import topics
from dopslam_ros.messages.common import Frames, stamp_ns
from dopslam_ros.messages.inputs import (
    make_control,
    make_measurements,
    read_control,
    read_measurements,
)


def test_measurements_survive_the_passage() -> None:
    """A set through a message and its bytes is the same set, NaN and covariances included."""
    rng = np.random.default_rng(1)
    values = rng.uniform(-1.0, 1.0, (5, 6))
    values[1, 5] = values[3, 2] = np.nan
    roots = rng.normal(size=(5, 6, 6))
    covariances = roots @ roots.swapaxes(1, 2)
    covariances[2] = 0.0
    covariances[3] = 0.5 * (covariances[3] + covariances[3].T)
    before = MeasurementSet(values, covariances)
    type_name = topics.CHANNEL_MEASUREMENTS.type_name
    message = make_measurements(message_class, 123_456_789_012, before, Frames(base="m"))
    again = deserialize(serialize(message, type_name), type_name)
    after = read_measurements(again)
    # Azimuths are wrapped, which may cost them their last bit.
    assert np.allclose(after.values, values, rtol=0.0, atol=1e-15, equal_nan=True)
    measured = np.isfinite(values)
    both = measured[:, :, None] & measured[:, None, :]
    assert np.array_equal(after.covariances, np.where(both, covariances, 0.0))
    assert stamp_ns(again.header) == 123_456_789_012 and again.header.frame_id == "m"
    assert after.base_station.tolist() == [BS_ID] * len(values)
    assert all(np.isnan(path.snr_db) for path in again.paths)


def test_controls_survive_the_passage() -> None:
    control = Control(1.25, -0.5)
    assert read_control(make_control(message_class, 5, control, Frames())) == control
