"""Partitions done by many workers: processes of this machine, or a Dask cluster.

Both run the same function and hand its results over as they come; a result is only counted
when it has arrived, so a worker that dies costs the partitions it had in hand, which are done
again by others.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import partial
from importlib import import_module
from multiprocessing import get_context
from typing import Any

from mwdcal.errors import InputError

ONE_THREAD = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
ATTEMPTS = 3
"""How often a partition whose worker died is given to another."""
PATIENCE = "30s"
"""How long a cluster may take to answer and to have a worker."""

Work = Callable[[Any], bytes]


def results(
    work: Work, tasks: Sequence[Any], workers: int, scheduler: str | None
) -> Iterator[tuple[int, bytes]]:
    """Index and result of each task, in the order in which they are ready."""
    if scheduler:
        return _on_cluster(work, tasks, scheduler)
    if workers == 1 or len(tasks) == 1:
        return ((index, work(task)) for index, task in enumerate(tasks))
    return _on_cores(work, tasks, min(workers, len(tasks)))


def cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """Processes started here compute with one thread: there is one of them per core."""
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(dict.fromkeys(ONE_THREAD, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name)
            if value is not None:
                os.environ[name] = value


def _on_cores(work: Work, tasks: Sequence[Any], workers: int) -> Iterator[tuple[int, bytes]]:
    """By a pool of processes; a new pool where a process died."""
    left = list(range(len(tasks)))
    for _ in range(ATTEMPTS):
        try:
            for index, result in _by_pool(work, tasks, left, workers):
                left.remove(index)
                yield index, result
        except BrokenProcessPool:
            continue
        return
    raise InputError(
        f"a worker process died {ATTEMPTS} times, most likely for want of memory. Finished parts are "
        "kept: run the same command again with fewer --workers."
    )


def _by_pool(
    work: Work, tasks: Sequence[Any], left: Sequence[int], workers: int
) -> Iterator[tuple[int, bytes]]:
    """Results of one pool; no more tasks are handed out than keep it busy."""
    waiting = iter(tuple(left))
    with _one_thread_each(), ProcessPoolExecutor(workers, get_context("spawn")) as pool:
        running: dict[Future[bytes], int] = {}
        try:
            while True:
                for index in waiting:
                    running[pool.submit(work, tasks[index])] = index
                    if len(running) >= 2 * workers:
                        break
                if not running:
                    return
                for done in wait(running, return_when=FIRST_COMPLETED).done:
                    index = running.pop(done)
                    yield index, done.result()
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def _on_cluster(work: Work, tasks: Sequence[Any], address: str) -> Iterator[tuple[int, bytes]]:
    """By the workers of a Dask scheduler, which gives a dead worker's tasks to others."""
    try:
        distributed: Any = import_module("distributed")
    except ImportError:
        raise InputError(
            "--scheduler needs the extra 'cluster'. Install it, here and on every worker: "
            "pip install 'mwdcal[all,cluster]'"
        ) from None
    with _connected(partial(distributed.Client, address, timeout=PATIENCE), address) as client:
        futures = client.map(work, tasks, pure=False, retries=ATTEMPTS)
        places = {future.key: index for index, future in enumerate(futures)}
        arriving = distributed.as_completed(futures)
        del futures
        try:
            for future in arriving:
                result = future.result()
                future.release()
                yield places[future.key], result
        except distributed.KilledWorker as error:
            raise InputError(
                f"workers of {address} died again and again on the same part, most likely for want "
                "of memory. Finished parts are kept: run the same command again with larger workers."
            ) from error
        except ModuleNotFoundError as error:
            raise InputError(
                f"a worker of {address} has no {error.name}. Install mwdcal there: pip install "
                "'mwdcal[all,cluster]'"
            ) from error


@contextmanager
def _connected(connect: Callable[[], Any], address: str) -> Iterator[Any]:
    """A client of a cluster that has a worker."""
    try:
        client = connect()
    except (OSError, ValueError, TimeoutError) as error:
        raise InputError(
            f"--scheduler {address}: no Dask scheduler answers there ({str(error)[:120]}). Start "
            "one with `dask scheduler`, and workers with `dask worker ADDRESS`."
        ) from error
    try:
        client.wait_for_workers(1, timeout=PATIENCE)
        yield client
    except TimeoutError as error:
        raise InputError(
            f"--scheduler {address}: the scheduler has no workers. Start some: dask worker {address}"
        ) from error
    finally:
        client.close()
