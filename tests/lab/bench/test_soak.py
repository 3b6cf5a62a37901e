"""The long run in short: the same filter as everywhere, the same results in every process."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from dopslam_ros.bag import BagReader, BagWriter, message_class, serialize
from dopslam_ros.core.settings.parameters import commented_yaml
from dopslam_ros.lab.bench import soak
from dopslam_ros.messages import topics
from dopslam_ros.messages.common import make_text
from dopslam_ros.offline.replay import replay
from dopslam_ros.simulation.matched import filter_parameters_for
from dopslam_ros.simulation.scenario import load_scenario

STEPS = 60


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bag of a short run."""
    bag = tmp_path_factory.mktemp("soak") / "inputs"
    soak.record_inputs(bag, STEPS)
    return bag


def test_it_says_what_a_replay_says(
    inputs: Path, tmp_path: Path, bag_payloads: Callable[..., list[bytes]]
) -> None:
    """Every message is the one that `dopslam replay` writes."""
    said: dict[str, list[bytes]] = {}
    for answer in soak.answers(inputs):
        for topic, payload in answer:
            said.setdefault(topic.name, []).append(payload)
    assert len(said[topics.UE_STATE.name]) == STEPS
    settings = filter_parameters_for(load_scenario("paper"))
    topic = topics.FILTER_PARAMETERS
    with BagWriter(tmp_path / "with_settings") as writer:
        writer.add_topic("/" + topic.name, topic.type_name)
        text = serialize(make_text(message_class, commented_yaml(settings)), topic.type_name)
        writer.write("/" + topic.name, text, 1)
        for message in BagReader(inputs).messages():
            writer.add_topic(message.topic, message.type_name)
            writer.write(message.topic, message.payload, message.log_time_ns)
    with BagWriter(tmp_path / "replay") as writer:
        replay(BagReader(tmp_path / "with_settings"), writer=writer)
    for topic in (topics.UE_STATE, topics.LANDMARKS, topics.ODOMETRY, topics.LANDMARK_MARKERS):
        assert said[topic.name] == bag_payloads(tmp_path / "replay", topic), topic.name


def test_a_tenth_of_the_run_each(inputs: Path, tmp_path: Path) -> None:
    """Ten times and ten sizes; the digest is that of the messages, whichever those are."""
    one, again = soak.soaked(inputs, STEPS), soak.soaked(inputs, STEPS)
    assert len(one.seconds) == len(one.occupied) == soak.PARTS
    assert min(one.seconds) > 0.0 and min(one.occupied) > 2**20
    assert one.digest == again.digest
    soak.record_inputs(tmp_path / "shorter", STEPS - 1)
    assert soak.soaked(tmp_path / "shorter", STEPS - 1).digest != one.digest


def test_the_benchmark_shows_memory_and_times(monkeypatch: pytest.MonkeyPatch) -> None:
    """In processes of their own; memory is as much at the end as after the first tenth."""
    monkeypatch.setattr(soak, "QUICK_SECONDS", 30.0)
    measured = soak.soak(quick=True)
    assert [ratio.name for ratio in measured.ratios] == [
        "time of a set, last / second tenth",
        "memory, after the last / the first tenth",
    ]
    assert 0.5 < measured.ratios[1].value < 1.2
    assert "byte for byte, in another process" in measured.notes[0]


def test_other_results_in_the_second_process_are_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is reported then."""
    digests = iter("ab")

    def child(function: object, bag: Path, steps: int) -> soak.Soaked:
        return soak.Soaked(next(digests), [1.0, 1.0], [1, 1])

    monkeypatch.setattr(soak, "in_a_child", child)
    monkeypatch.setattr(soak, "QUICK_SECONDS", 1.0)
    with pytest.raises(RuntimeError, match="other results"):
        soak.soak(quick=True)
