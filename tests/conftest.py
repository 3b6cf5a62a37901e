"""What the integration tests share: short scenes, ROS in a domain of its own, node processes."""

from __future__ import annotations

import itertools
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

import dopslam_ros
from dopslam_ros.bag import BagReader, BagWriter, deserialize
from dopslam_ros.messages import topics
from dopslam_ros.simulation.recording import write_simulation
from dopslam_ros.simulation.scenario import load_scenario

if TYPE_CHECKING:
    from rclpy.node import Node

    from dopslam_ros.nodes.node import DopslamNode

STEPS = 8
SEED = 5
# The stamp of the first snapshot, as `write_simulation` has it [s].
START = 1.0
PATIENCE = 120.0
# Names of odd length: CDR leaves gaps behind them.
# What is only drawn comes with every set, so that it can be compared.
UNPACED = {"path_period": 0.0, "path_spacing": 0.0, "markers_period": 0.0}
FRAMES = {"map_frame": "world", "base_frame": "m"}

_DOMAINS = 100  # Fast DDS has ports for 1 ... 101 that no other program takes
_domains = itertools.count(7 * os.getpid())


def pytest_configure(config: pytest.Config) -> None:
    """Hears Ctrl-C; compiles before several processes would all do it at once."""
    # Who starts the tests in the background may have it ignored, also by all that they start.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    if getattr(config.option, "numprocesses", None):
        from dopslam_ros.core.pmb import FilterParameters
        from dopslam_ros.core.settings.bounding import BoundsParameters
        from dopslam_ros.simulation.warmup import warm_up_bounds, warm_up_filter

        warm_up_filter(FilterParameters())
        warm_up_bounds(BoundsParameters())
        # What only these compile they compile beside each other.
        others = [FilterParameters(density="pmbm"), FilterParameters(mapping=False)]
        with ProcessPoolExecutor(len(others)) as pool:
            list(pool.map(warm_up_filter, others))


def new_domain() -> int:
    """A ROS domain that no other test has, in this process or one beside it."""
    worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0")[2:])
    each = _DOMAINS // int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    return 1 + worker * each + next(_domains) % each


def wait_until(
    condition: Callable[[], object], timeout: float = PATIENCE, step: Callable[[], object] = bool
) -> None:
    """Waits for something that other processes bring about; fails when it does not come.

    Args:
        condition: what is waited for.
        timeout: how long [s].
        step: what to do meanwhile.
    """
    end = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < end, f"waited {timeout:g} s in vain"
        if step is bool:
            time.sleep(0.02)
        else:
            step()


class Listener:
    """Keeps every message of some topics, as bytes.

    Attributes:
        node: the node behind it; a simulator or player can wait for it by its name.
        payloads: the bytes by the topic's name.
    """

    def __init__(self, ros: Ros, wanted: Iterable[topics.Topic], name: str = "listener") -> None:
        from dopslam_ros.nodes.middleware import middleware_class, reading_profile

        self.node = ros.node(name)
        self.payloads: dict[str, list[bytes]] = {topic.name: [] for topic in wanted}
        # The controls last: see nodes.joining.
        for topic in sorted(wanted, key=lambda t: t == topics.ODOMETRY_CONTROL):
            self.node.create_subscription(
                middleware_class(topic.type_name),
                topic.name,
                self.payloads[topic.name].append,
                reading_profile(topic),
                raw=True,
            )

    def count(self, topic: topics.Topic) -> int:
        """Messages of a topic so far."""
        return len(self.payloads[topic.name])

    def messages(self, topic: topics.Topic) -> list[Any]:
        """Them, deserialised."""
        return [deserialize(bytes(p), topic.type_name) for p in self.payloads[topic.name]]

    def bytes(self, topic: topics.Topic) -> list[bytes]:
        """Them, as they came."""
        return [bytes(p) for p in self.payloads[topic.name]]


class Ros:
    """A context of rclpy in a domain of its own, with an executor that runs in this thread.

    Attributes:
        domain: the ROS domain.
    """

    def __init__(self, domain: int) -> None:
        import rclpy
        from rclpy.context import Context
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.signals import SignalHandlerOptions

        self.domain = domain
        self.context = Context()
        rclpy.init(
            args=[],
            context=self.context,
            domain_id=domain,
            signal_handler_options=SignalHandlerOptions.NO,
        )
        self.executor = SingleThreadedExecutor(context=self.context)
        self._nodes: list[Node] = []

    def node(self, name: str) -> Node:
        """A plain node."""
        from rclpy.node import Node

        node = Node(name, context=self.context, parameter_overrides=[])
        self._keep(node)
        return node

    def start(
        self, kind: Callable[..., DopslamNode], namespace: str = "", **parameters: object
    ) -> Any:
        """A node of the package with parameters as given at its start."""
        from rclpy.parameter import Parameter

        overrides = [Parameter(name, value=value) for name, value in parameters.items()]
        options = {"namespace": namespace} if namespace else {}
        node = kind(context=self.context, parameter_overrides=overrides, **options)
        self._keep(node)
        return node

    def listen(self, *wanted: topics.Topic, name: str = "listener") -> Listener:
        """Keeps what comes on some topics."""
        return Listener(self, wanted, name)

    def spin_until(self, condition: Callable[[], object], timeout: float = PATIENCE) -> None:
        """Runs the nodes until the condition holds; fails when it never does."""
        wait_until(condition, timeout, lambda: self.executor.spin_once(timeout_sec=0.05))

    def remove(self, node: Any) -> None:
        """Ends a node as its process would."""
        if hasattr(node, "close"):
            node.close()
        self.executor.remove_node(node)
        self._nodes.remove(node)
        node.destroy_node()

    def close(self) -> None:
        """Ends everything."""
        for node in list(self._nodes):
            self.remove(node)
        self.executor.shutdown()
        self.context.try_shutdown()

    def _keep(self, node: Node) -> None:
        self._nodes.append(node)
        self.executor.add_node(node)


class Process:
    """A command that runs, with what it writes."""

    def __init__(self, command: list[str], log: Path, domain: int, folder: Path) -> None:
        root = str(Path(dopslam_ros.__file__).resolve().parents[1])
        paths = [root, *filter(None, [os.environ.get("PYTHONPATH")])]
        self._out, self._err = log.with_suffix(".out"), log.with_suffix(".err")
        with self._out.open("wb") as out, self._err.open("wb") as err:
            self.popen = subprocess.Popen(
                command,
                stdout=out,
                stderr=err,
                stdin=subprocess.DEVNULL,
                cwd=folder,
                start_new_session=True,
                env={
                    **os.environ,
                    "ROS_DOMAIN_ID": str(domain),
                    "PYTHONPATH": os.pathsep.join(paths),
                },
            )

    @property
    def stdout(self) -> str:
        """Standard output so far."""
        return self._out.read_text("utf-8", errors="replace")

    @property
    def stderr(self) -> str:
        """Standard error so far; the log of a node is in it."""
        return self._err.read_text("utf-8", errors="replace")

    def wait_for(self, text: str) -> None:
        """Waits for a text in the log."""
        wait_until(lambda: text in self.stderr or self.popen.poll() is not None)
        assert text in self.stderr, self.stderr

    def wait(self) -> int:
        """Waits for the end; the exit code."""
        return self.popen.wait(PATIENCE)

    def stop(self, number: int = signal.SIGINT) -> int:
        """Sends a signal and waits for the end; the exit code."""
        self.popen.send_signal(number)
        return self.wait()

    def interrupt_all(self) -> int:
        """Ctrl-C as a terminal sends it, to children too; the exit code."""
        os.killpg(self.popen.pid, signal.SIGINT)
        return self.wait()


class Processes:
    """Starts processes in one domain; ends those that still run."""

    def __init__(self, folder: Path) -> None:
        self.domain = new_domain()
        self.folder = folder
        self._started: list[Process] = []

    def node(self, name: str, *arguments: str, **parameters: object) -> Process:
        """A node of the package in a process of its own."""
        command = [sys.executable, "-m", f"dopslam_ros.nodes.{name}", "--ros-args", *arguments]
        for key, value in parameters.items():
            command += ["-p", f"{key}:={value}"]
        return self._start(command)

    def dopslam(self, *arguments: object) -> Process:
        """The command ``dopslam``."""
        return self._start([sys.executable, "-m", "dopslam_ros.cli.main", *map(str, arguments)])

    def close(self) -> None:
        """Ends what still runs."""
        for process in self._started:
            if process.popen.poll() is None:
                process.popen.kill()
                process.popen.wait()

    def _start(self, command: list[str]) -> Process:
        log = self.folder / f"process{len(self._started)}"
        self._started.append(Process(command, log, self.domain, self.folder))
        return self._started[-1]


@dataclass(frozen=True)
class LiveRun:
    """A run through simulator, filter, bounds and recorder on one executor.

    Attributes:
        bag: what the recorder wrote.
        heard: every message, as a listener beside the recorder heard it, by the topic's name.
    """

    bag: Path
    heard: dict[str, list[bytes]]

    def messages(self, topic: topics.Topic) -> list[Any]:
        """The messages of a topic."""
        return [deserialize(p, topic.type_name) for p in self.heard[topic.name]]


def payloads(bag: Path, topic: topics.Topic, prefix: str = "/") -> list[bytes]:
    """The messages of a topic in a bag."""
    name = topic.name if topic.name.startswith("/") else prefix + topic.name
    return [message.payload for message in BagReader(bag).messages({name})]


def written(recorder: DopslamNode) -> int:
    """Messages that a recorder node has written."""
    return int(dict(recorder.health()[2])["messages_written"])


def run_live(ros: Ros, bag: Path, scene: Path) -> LiveRun:
    """Runs the short scene through all nodes in one process."""
    from dopslam_ros.nodes.bounds import BoundsNode
    from dopslam_ros.nodes.filter import FilterNode
    from dopslam_ros.nodes.recorder import RecorderNode
    from dopslam_ros.nodes.simulator import SimulatorNode

    listener = ros.listen(*topics.RECORDED)
    filtering = ros.start(FilterNode, **FRAMES, **UNPACED)
    bounding = ros.start(BoundsNode, map_frame=FRAMES["map_frame"])
    recording = ros.start(RecorderNode, bag=str(bag))
    simulating = ros.start(
        SimulatorNode,
        scenario=str(scene),
        seed=SEED,
        rate=50.0,
        start_time=START,
        wait_for_nodes="filter,bounds,recorder,listener",
        **FRAMES,
    )
    last = (topics.UE_STATE, topics.LANDMARK_MARKERS, topics.BOUNDS)
    ros.spin_until(lambda: simulating.finished() and all(listener.count(t) == STEPS for t in last))
    for node in (simulating, filtering, bounding):
        node.publish_diagnostics()
        ros.remove(node)

    def told() -> set[str]:
        return {s.name for m in listener.messages(topics.DIAGNOSTICS) for s in m.status}

    ros.spin_until(
        lambda: (
            told() >= {"/simulator", "/filter", "/bounds"}
            and written(recording) == sum(map(listener.count, topics.RECORDED))
        )
    )
    ros.remove(recording)
    return LiveRun(
        bag, {name: [bytes(p) for p in found] for name, found in listener.payloads.items()}
    )


@pytest.fixture(scope="session", autouse=True)
def _stay_on_this_machine() -> Iterator[None]:
    """Nothing of a test leaves this machine."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        yield


@pytest.fixture(scope="session")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The paper's scene, cut to a few steps."""
    path = tmp_path_factory.mktemp("scene") / "short.yaml"
    path.write_text(
        "base: paper\nname: short\n"
        f"controls: [{{steps: {STEPS}, speed: 22.22, turn_rate: 0.3141592653589793}}]\n",
        "utf-8",
    )
    return path


@pytest.fixture(scope="session")
def simulated(tmp_path_factory: pytest.TempPathFactory, scene: Path) -> Path:
    """A bag with a simulated run of the short scene; to be read only."""
    bag = tmp_path_factory.mktemp("bags") / "simulated"
    with BagWriter(bag, flush_seconds=None) as writer:
        assert write_simulation(load_scenario(scene), SEED, writer) == STEPS
    return bag


@pytest.fixture(scope="session")
def cut_bag(simulated: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The simulated bag, cut off in the middle of its messages."""
    path = tmp_path_factory.mktemp("bags") / "cut.mcap"
    data = next(simulated.glob("*.mcap")).read_bytes()
    path.write_bytes(data[: len(data) * 3 // 10])
    assert 4 < BagReader(path).message_count < BagReader(simulated).message_count
    return path


@pytest.fixture(scope="session")
def live(tmp_path_factory: pytest.TempPathFactory, scene: Path) -> LiveRun:
    """A live run of the short scene with its bag; to be read only."""
    ros = Ros(new_domain())
    try:
        return run_live(ros, tmp_path_factory.mktemp("bags") / "live", scene)
    finally:
        ros.close()


@pytest.fixture
def ros() -> Iterator[Ros]:
    """ROS in a domain of its own."""
    ros = Ros(new_domain())
    yield ros
    ros.close()


@pytest.fixture(scope="session")
def session_ros() -> Iterator[Ros]:
    """ROS in a domain of its own, for fixtures that several tests share."""
    ros = Ros(new_domain())
    yield ros
    ros.close()


@pytest.fixture
def processes(tmp_path: Path) -> Iterator[Processes]:
    """Starts node processes in a domain of their own."""
    processes = Processes(tmp_path)
    yield processes
    processes.close()


@pytest.fixture
def in_background() -> Iterator[None]:
    """Ctrl-C is ignored, also by what is started, as in a job that a script starts with `&`."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture
def bag_payloads() -> Callable[..., list[bytes]]:
    """Function ``(bag, topic, prefix="/")``: the bytes of a topic in a bag."""
    return payloads


@pytest.fixture
def wait() -> Callable[..., None]:
    """Function ``(condition, timeout)``: waits for other processes."""
    return wait_until
