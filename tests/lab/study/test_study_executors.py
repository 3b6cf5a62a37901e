"""Where a study is computed changes no bit of it; what goes wrong there is told."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import dopslam_ros
from dopslam_ros.lab.study import executors
from dopslam_ros.lab.study.executors import blas_is_limited, run_local, run_on_dask
from dopslam_ros.lab.study.plan import Plan, StudyError, Task, software
from dopslam_ros.lab.study.run import Outcome
from dopslam_ros.simulation.scenario import Scenario

# The extra 'cluster', which rosdep has no keys for; `make setup` installs it.
threadpoolctl = pytest.importorskip("threadpoolctl")
pytest.importorskip("distributed")

PATIENCE = 40.0


@pytest.fixture(scope="module")
def plan(short: Scenario) -> Plan:
    return Plan(short, ("joint", "genie"), (0.1, None), 3, 9)


@pytest.fixture(scope="module")
def expected(plan: Plan) -> dict[Task, bytes]:
    return tables(run_local(plan, list(plan.tasks()), 1))


def tables(outcomes: Iterator[Outcome]) -> dict[Task, bytes]:
    found = {}
    for outcome in outcomes:
        assert outcome.part is not None, outcome.error
        assert outcome.task not in found
        found[outcome.task] = outcome.part.table.tobytes()
    return found


# --- this machine --------------------------------------------------------------------------------


def test_processes_change_no_bit(plan: Plan, expected: dict[Task, bytes]) -> None:
    assert list(expected) == list(plan.tasks())
    assert tables(run_local(plan, list(plan.tasks()), 2)) == expected


def test_a_few_tasks_only(plan: Plan, expected: dict[Task, bytes]) -> None:
    some = list(plan.tasks())[3:6]
    assert tables(run_local(plan, some, 8)) == {task: expected[task] for task in some}


def test_a_failing_task_leaves_the_others_alone(plan: Plan, expected: dict[Task, bytes]) -> None:
    bad = Task("joint", 0.1, -1)  # no generator has such a seed
    outcomes = list(run_local(plan, [bad, *plan.tasks()], 2))
    failed = [outcome for outcome in outcomes if outcome.part is None]
    assert [outcome.task for outcome in failed] == [bad]
    assert "ValueError" in failed[0].error
    assert tables(o for o in outcomes if o.part is not None) == expected


def children() -> set[int]:
    """The processes that this one has started."""
    threads = Path("/proc/self/task").iterdir()
    found: set[int] = set()
    for thread in threads:
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):  # it has just ended
            found |= {int(pid) for pid in (thread / "children").read_text().split()}
    return found


def test_a_killed_process_is_told(short: Scenario) -> None:
    long = replace(short, controls=short.controls[:1] * 400)
    before = children()
    outcomes = run_local(Plan(long, ("joint",), (0.1,), 2, 9), [Task("joint", 0.1, 0)] * 2, 2)

    def kill_one() -> None:
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end:
            started = children() - before
            if len(started) == 2:
                os.kill(min(started), signal.SIGKILL)
                return
            time.sleep(0.05)

    killer = threading.Thread(target=kill_one)
    killer.start()
    with pytest.raises(StudyError, match=r"a worker process was killed.*--workers"):
        list(outcomes)
    killer.join()


def test_blas_has_one_thread_while_a_task_runs(plan: Plan, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []

    def watch(plan: Plan, versions: dict[str, str], task: Task) -> Outcome:
        seen.append({pool["num_threads"] for pool in threadpoolctl.threadpool_info()})
        return Outcome(task, None, "")

    monkeypatch.setattr(executors, "execute", watch)
    with threadpoolctl.threadpool_limits(2):
        assert {pool["num_threads"] for pool in threadpoolctl.threadpool_info()} == {2}
        list(run_local(plan, [Task("joint", 0.1, 0)], 1))
        assert seen == [{1}]
        assert {pool["num_threads"] for pool in threadpoolctl.threadpool_info()} == {2}


def test_it_is_known_whether_blas_is_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        monkeypatch.delenv(name, raising=False)
    assert blas_is_limited()
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert not blas_is_limited()
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "1")
    assert blas_is_limited()


# --- Dask ----------------------------------------------------------------------------------------


class Cluster:
    """A Dask scheduler and workers as processes of this machine."""

    def __init__(self, folder: Path) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.address = f"tcp://127.0.0.1:{free.getsockname()[1]}"
        self._folder = folder
        self.processes: list[subprocess.Popen[bytes]] = []

    def start_scheduler(self) -> None:
        port = self.address.rpartition(":")[2]
        self._start("scheduler", "--host", "127.0.0.1", "--port", port, "--no-dashboard")

    def start_worker(self) -> None:
        self._start(
            "worker",
            self.address,
            "--nthreads",
            "1",
            "--no-nanny",
            "--no-dashboard",
            "--local-directory",
            str(self._folder),
        )

    def _start(self, kind: str, *arguments: str) -> None:
        root = str(Path(dopslam_ros.__file__).resolve().parents[1])
        paths = [root, *filter(None, [os.environ.get("PYTHONPATH")])]
        with (self._folder / f"{len(self.processes)}.log").open("wb") as log:
            self.processes.append(
                subprocess.Popen(
                    [sys.executable, "-m", f"distributed.cli.dask_{kind}", *arguments],
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=log,
                    env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)},
                )
            )

    def close(self) -> None:
        for process in self.processes:
            process.kill()
            process.wait()


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[Cluster]:
    cluster = Cluster(tmp_path)
    yield cluster
    cluster.close()


@pytest.fixture
def said() -> list[str]:
    return []


@pytest.mark.timeout(120)
def test_a_cluster_changes_no_bit(
    plan: Plan, expected: dict[Task, bytes], cluster: Cluster, said: list[str]
) -> None:
    """Also when the workers come late, and one of them is lost on the way."""

    def say(text: str) -> None:
        said.append(text)
        for _ in range(2):
            cluster.start_worker()

    cluster.start_scheduler()
    outcomes = run_on_dask(plan, list(plan.tasks()), cluster.address, say)
    first = next(outcomes)
    assert len(said) == 1 and "no workers yet" in said[0] and cluster.address in said[0]
    cluster.processes[1].kill()
    assert first.part is not None
    rest = tables(outcomes)
    assert {first.task: first.part.table.tobytes(), **rest} == expected


@pytest.mark.timeout(120)
def test_a_lost_scheduler_is_told(plan: Plan, cluster: Cluster, said: list[str]) -> None:
    cluster.start_scheduler()
    cluster.start_worker()
    outcomes = run_on_dask(plan, list(plan.tasks()), cluster.address, said.append)
    assert next(outcomes).part is not None
    cluster.processes[0].kill()
    with pytest.raises(StudyError, match=f"scheduler at '{cluster.address}' was lost"):
        list(outcomes)


@pytest.mark.timeout(60)
def test_a_worker_of_another_version_computes_nothing(
    plan: Plan, cluster: Cluster, said: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    cluster.start_scheduler()
    cluster.start_worker()
    monkeypatch.setattr(executors, "software", lambda: {**software(), "numpy": "1.26.0"})
    (outcome,) = run_on_dask(plan, list(plan.tasks())[:1], cluster.address, said.append)
    assert outcome.part is None
    assert f"a worker has numpy {np.__version__}, the study 1.26.0" in outcome.error


@pytest.mark.parametrize("listens", ["nobody", "something silent", "something else"])
def test_no_scheduler_there(
    plan: Plan, said: list[str], listens: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert executors.CONNECT_SECONDS <= 10.0
    monkeypatch.setattr(executors, "CONNECT_SECONDS", 1.5)
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"tcp://127.0.0.1:{server.getsockname()[1]}"
        if listens == "nobody":
            server.close()

        def answer() -> None:
            connection, _ = server.accept()
            with connection:
                connection.sendall(b"HTTP/1.1 400 Bad Request\r\n\r\n" * 9)

        if listens == "something else":
            threading.Thread(target=answer, daemon=True).start()
        begin = time.monotonic()
        with pytest.raises(StudyError, match=f"no Dask scheduler at '{address}'.*dask scheduler"):
            next(run_on_dask(plan, list(plan.tasks()), address, said.append))
        assert time.monotonic() - begin < 4.0


@pytest.mark.parametrize("address", ["", "host", "http://127.0.0.1:8786"])
def test_what_is_no_address(plan: Plan, said: list[str], address: str) -> None:
    with pytest.raises(StudyError, match="no Dask scheduler at"):
        next(run_on_dask(plan, list(plan.tasks()), address, said.append))


def test_without_dask(plan: Plan, said: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(StudyError, match=r"pip install 'dopslam_ros\[cluster\]'"):
        next(run_on_dask(plan, list(plan.tasks()), "tcp://127.0.0.1:1", said.append))
