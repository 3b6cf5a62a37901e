"""States and maps as messages: nothing is lost."""

from __future__ import annotations

import numpy as np
from made_maps import BS, SP, VA, landmarks

from dopslam_ros.bag import deserialize, message_class, serialize
from dopslam_ros.core.settings.layout import LandmarkType
from dopslam_ros.messages import topics
from dopslam_ros.messages.common import Frames
from dopslam_ros.messages.states import make_map, make_ue_state, read_map, read_ue_state

MAP = topics.LANDMARKS.type_name


def test_states_and_maps_survive_the_passage() -> None:
    """What goes in comes out: state, covariance, map with its BS."""
    rng = np.random.default_rng(2)
    mean, root = rng.normal(size=4), rng.normal(size=(4, 4))
    state = make_ue_state(message_class, 5, mean, root @ root.T, Frames())
    assert [state.x, state.y, state.heading, state.clock_bias] == mean.tolist()
    after = read_ue_state(state)
    assert np.array_equal(after[0], mean) and np.array_equal(after[1], root @ root.T)
    estimates = landmarks((3, VA), (7, SP))
    written = serialize(make_map(message_class, 5, estimates, BS, Frames()), MAP)
    arrays = read_map(deserialize(written, MAP))
    assert arrays.ids.tolist() == [0, 3, 7]
    assert arrays.types.tolist() == [LandmarkType.BS, VA, SP]
    assert np.array_equal(arrays.positions, np.vstack([BS, estimates.positions]))
    assert np.array_equal(arrays.covariances[1:], estimates.covariances)
    assert np.array_equal(arrays.of_type(LandmarkType.SP), estimates.positions[1:])
