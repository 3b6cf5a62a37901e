"""Where the tasks of a study are computed: here, on all cores, or on a Dask cluster.

A task gives the same bits wherever it is computed: it has a generator of its own and BLAS is kept
to one thread. (Processors of another kind, for which NumPy and BLAS have other kernels, round
otherwise.)
"""

from __future__ import annotations

import asyncio
import contextlib
import importlib
import importlib.util
import logging
import multiprocessing
import os
import signal
import threading
import traceback
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import CancelledError, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from typing import Any

from dopslam_ros.lab.study.plan import Plan, StudyError, Task, software
from dopslam_ros.lab.study.run import Outcome, execute

CONNECT_SECONDS = 8.0
# Variables by which a user keeps BLAS to a number of threads.
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def outcomes_of(
    plan: Plan,
    tasks: Sequence[Task],
    workers: int | None,
    scheduler: str | None,
    say: Callable[[str], None],
) -> Generator[Outcome, None, None]:
    """Computes tasks here, or on a cluster where one is named, and yields each as it ends.

    Args:
        plan: the study.
        tasks: those to do.
        workers: processes of this machine; None for one a core.
        scheduler: address of a Dask scheduler, or None.
        say: is told what keeps the study waiting, and what its digits depend on.

    Raises:
        StudyError: a process was killed, or the cluster cannot be used.
    """
    if scheduler is not None:
        yield from run_on_dask(plan, tasks, scheduler, say)
        return
    if not blas_is_limited():
        say(
            "BLAS may use several threads, and the last digits depend on how many: install"
            " 'threadpoolctl', or set OMP_NUM_THREADS=1"
        )
    yield from run_local(plan, tasks, workers)


def run_local(plan: Plan, tasks: Sequence[Task], workers: int | None) -> Iterator[Outcome]:
    """Computes tasks in processes of this machine, and yields each as it ends.

    Args:
        plan: the study.
        tasks: those to do.
        workers: processes; None for one a core; with 1 it is done in this process.

    Raises:
        StudyError: a process was killed.
    """
    one = partial(execute, plan, software())
    workers = min(workers or len(os.sched_getaffinity(0)), len(tasks))
    if workers <= 1:
        with one_blas_thread():
            yield from map(one, tasks)
        return
    pool = ProcessPoolExecutor(workers, initializer=_begin_worker)
    try:
        for future in as_completed([pool.submit(one, task) for task in tasks]):
            yield future.result()
    except BrokenProcessPool as error:
        raise StudyError(
            "a worker process was killed, perhaps for want of memory: fewer --workers need less"
        ) from error
    finally:
        pool.shutdown(cancel_futures=True)


def _begin_worker() -> None:
    """Ctrl-C is for the main process alone, which gives up what has not begun."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    one_blas_thread()
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """A main process that was killed leaves no workers behind."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def run_on_dask(
    plan: Plan, tasks: Sequence[Task], address: str, say: Callable[[str], None]
) -> Iterator[Outcome]:
    """Computes tasks on the workers of a Dask scheduler, and yields each as it ends.

    The workers need this package. A task whose worker is lost is done again by another one.

    Args:
        plan: the study.
        tasks: those to do.
        address: of the scheduler, as tcp://host:port.
        say: is told what keeps the study waiting.

    Raises:
        StudyError: Dask is not installed, no scheduler answers, or it was lost.
    """
    try:
        distributed: Any = importlib.import_module("distributed")
    except ImportError as error:
        raise StudyError(
            "--scheduler needs Dask: pip install 'dopslam_ros[cluster]', or 'distributed' alone"
        ) from error
    for name in ("distributed", "distributed.client"):
        # What goes wrong comes as an exception, and is told in one line.
        logging.getLogger(name).setLevel(logging.CRITICAL)
    _find_scheduler(distributed, address)
    client = distributed.Client(address, timeout=CONNECT_SECONDS)
    try:
        if not client.scheduler_info()["workers"]:
            say(f"'{address}' has no workers yet: the study waits for 'dask worker {address}'")
        one = partial(_execute_on_dask, plan, software())
        futures = client.map(one, tasks, pure=False, key="dopslam-study")
        sent = {future.key: task for future, task in zip(futures, tasks, strict=True)}
        for future in distributed.as_completed(futures):
            yield _outcome(future, sent[future.key], address)
            future.release()
    finally:
        client.close()


def _find_scheduler(distributed: Any, address: str) -> None:
    """Raises StudyError if no Dask scheduler answers at the address."""

    async def ask() -> str:
        async with distributed.rpc(address, timeout=CONNECT_SECONDS) as scheduler:
            return str((await scheduler.identity())["type"])

    try:
        answer = asyncio.run(asyncio.wait_for(ask(), CONNECT_SECONDS))
    except Exception as error:  # whatever else listens there answers in its own way
        answer = str(error) or f"no answer within {CONNECT_SECONDS:g} s"
    if answer != "Scheduler":
        raise StudyError(
            f"no Dask scheduler at '{address}' ({answer}): start one with 'dask scheduler' and give"
            " the address that it prints, as tcp://host:8786"
        )


def _outcome(future: Any, task: Task, address: str) -> Outcome:
    try:
        outcome: Outcome = future.result()
    except CancelledError as error:
        raise StudyError(f"the Dask scheduler at '{address}' was lost") from error
    except Exception:  # the worker could not even begin: lost too often, or without this package
        return Outcome(task, None, traceback.format_exc())
    return outcome


def _execute_on_dask(plan: Plan, versions: dict[str, str], task: Task) -> Outcome:
    one_blas_thread()
    return execute(plan, versions, task)


def one_blas_thread() -> contextlib.AbstractContextManager[object]:
    """Keeps BLAS to one thread, until the end of the context it returns or for good."""
    try:
        from threadpoolctl import threadpool_limits
    except ImportError:
        return contextlib.nullcontext()
    limits: contextlib.AbstractContextManager[object] = threadpool_limits(1)
    return limits


def blas_is_limited() -> bool:
    """Whether BLAS computes with one thread: by this module, or because the user says so."""
    known = importlib.util.find_spec("threadpoolctl") is not None
    return known or any(os.environ.get(name) == "1" for name in _THREADS)
