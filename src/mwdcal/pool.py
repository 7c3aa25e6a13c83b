"""Parts of a fleet done by many workers: processes of this machine, or a Dask cluster.

Both run the same two steps, `load` and `solve`, and hand results over as they come. Processes
get what was loaded here, where a row group is decoded once; workers of a cluster load for
themselves. A result only counts when it has arrived, so a worker that dies costs what it had
in hand, which is done again by others. Where results are large, `solve` writes them to a file and returns none.
"""

from __future__ import annotations

import ctypes
import gc
import logging
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import forkserver, resource_tracker
from multiprocessing.context import BaseContext
from queue import Empty, SimpleQueue
from types import ModuleType
from typing import Any

from mwdcal import extras
from mwdcal.errors import InputError, reason
from mwdcal.signals import held

ONE_THREAD = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
KEPT_MEMORY = {"MALLOC_MMAP_THRESHOLD_": (-3, 2**25), "MALLOC_TRIM_THRESHOLD_": (-1, 2**29)}
"""Sizes below which the GNU allocator uses memory again, by environment variable: number for `mallopt`, and bytes."""
WORKER_SETTINGS = {
    **dict.fromkeys(ONE_THREAD, "1"),
    **{name: str(size) for name, (_, size) in KEPT_MEMORY.items()},
    "JE_ARROW_MALLOC_CONF": "background_thread:false",
}
"""Environment of a worker: there is one per core, and it keeps the memory that it will need again.

The process that workers are copies of has one thread: Python warns of copies of several.
"""
CLUSTER = "parquet,cluster"
"""The extras that a worker of a cluster needs."""
ATTEMPTS = 3
"""How often a part whose worker died is given to another."""
MOST_PROCESSES = 61
"""Worker processes of one pool: Windows cannot wait for more."""
WAIT_SECONDS = 0.5
"""Seconds of one wait for results: on Windows, Ctrl-C has no effect before a wait is over."""
CLUSTER_TIMEOUT = 30.0
"""Seconds in which a scheduler must answer, and have a worker; asked again after as long a silence."""
CLOSING = 5.0
"""Seconds for the farewell to a scheduler."""
COMMAND, WORKER = "mwdcal.app.cli", "mwdcal.app.worker_preload"
"""Modules that a worker process has loaded before it is given anything."""


@dataclass(frozen=True)
class Steps:
    """Work on a task: `solve(load(task))`; both can be sent to another process."""

    load: Callable[[Any], Any]
    solve: Callable[[Any], Any]

    def __call__(self, task: Any) -> Any:
        """Both steps at one place."""
        return self.solve(self.load(task))


@contextmanager
def preparing(workers: int | None) -> Iterator[None]:
    """While the command is loaded, so is the process that its workers will be copies of.

    `workers`: None for one per core. The command computes with one thread, as they do.
    """
    context = _context()
    _keep_memory()
    with _settings_of_workers():
        if (workers or os.cpu_count() or 1) > 1 and context.get_start_method() == "forkserver":
            resource_tracker.ensure_running()  # its start would unblock the interruption again
            before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGHUP})
            try:
                forkserver.ensure_running()
            finally:
                signal.pthread_sigmask(signal.SIG_SETMASK, before)
        yield
    gc.freeze()  # what is loaded stays: looking through it again takes long, at the end above all


def results(
    steps: Steps, tasks: Sequence[Any], workers: int, scheduler: str | None
) -> Iterator[tuple[int, Any]]:
    """Index and result of each task, in the order in which they are ready."""
    if scheduler:
        return _on_cluster(steps, tasks, scheduler)
    if workers == 1 or len(tasks) == 1:
        return ((index, steps(task)) for index, task in enumerate(tasks))
    return _on_cores(steps, tasks, min(workers, len(tasks), MOST_PROCESSES))


def _keep_memory() -> None:
    """Have this process use its memory again as workers do, where the C library can be told so."""
    with suppress(AttributeError, OSError, TypeError):  # other C libraries; TypeError: Windows
        library = ctypes.CDLL(None)
        for parameter, size in KEPT_MEMORY.values():
            library.mallopt(parameter, size)


@contextmanager
def _settings_of_workers() -> Iterator[None]:
    """The environment of processes that are started here."""
    before = {name: os.environ[name] for name in WORKER_SETTINGS if name in os.environ}
    os.environ.update(WORKER_SETTINGS)
    try:
        yield
    finally:
        for name in WORKER_SETTINGS:
            del os.environ[name]
        os.environ.update(before)


def _context() -> BaseContext:
    """Clean processes; where the system can, copies of one that has loaded everything."""
    if "forkserver" not in multiprocessing.get_all_start_methods():
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([COMMAND, WORKER])
    return context


def _follow_the_command() -> None:
    """A worker leaves interruptions from the keyboard to the command, and ends when that is gone.

    While it lives, so does the process that workers are copies of: each holds its pipe open.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """Wait for the end of the parent process, however that comes."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _on_cores(steps: Steps, tasks: Sequence[Any], workers: int) -> Iterator[tuple[int, Any]]:
    """By a pool of processes; a new pool where a process died."""
    left = list(range(len(tasks)))
    for _ in range(ATTEMPTS):
        try:
            for index, result in _by_pool(steps, tasks, left, workers):
                left.remove(index)
                yield index, result
        except BrokenProcessPool:
            continue
        except OSError as error:
            raise InputError(
                f"worker processes cannot be started ({reason(error)}). Finished parts are kept: run the same "
                "command again with fewer `workers`."
            ) from error
        return
    raise InputError(
        f"a worker process died {ATTEMPTS} times, most likely for want of memory. Finished parts are "
        "kept: run the same command again with fewer `workers`."
    )


def _by_pool(
    steps: Steps, tasks: Sequence[Any], left: Sequence[int], workers: int
) -> Iterator[tuple[int, Any]]:
    """Results of one pool; no more tasks are loaded than keep it busy."""
    waiting = iter(tuple(left))
    with (
        _settings_of_workers(),
        ProcessPoolExecutor(workers, _context(), _follow_the_command) as pool,
    ):
        running: dict[Future[Any], int] = {}
        try:
            while True:
                for index in waiting:
                    loaded = steps.load(tasks[index])
                    # a worker that nobody waits for would not find what it begins with
                    with held(), _without_main():
                        running[pool.submit(steps.solve, loaded)] = index
                    if len(running) >= 2 * workers:
                        break
                if not running:
                    return
                for done in _ready(running):
                    index = running.pop(done)
                    yield index, done.result()
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


@contextmanager
def _without_main() -> Iterator[None]:
    """Processes that are started here do not run the script of the caller again, which may have no guard."""
    main = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main


def _ready(running: Iterable[Future[Any]]) -> set[Future[Any]]:
    """The futures that are done: one at least."""
    while not (done := wait(running, WAIT_SECONDS, FIRST_COMPLETED).done):
        pass
    return done


def _on_cluster(steps: Steps, tasks: Sequence[Any], address: str) -> Iterator[tuple[int, Any]]:
    """By the workers of a Dask scheduler, which gives a dead worker's tasks to others."""
    distributed = extras.load("distributed", "`scheduler`, here and on every worker,", CLUSTER)
    with _connected(distributed, address) as client:
        futures = client.map(steps, tasks, pure=False, retries=ATTEMPTS)
        waiting = {future.key: (index, future) for index, future in enumerate(futures)}
        del futures
        try:
            for key in _finished(client, waiting):
                index, future = waiting.pop(key)
                result = future.result(timeout=CLUSTER_TIMEOUT)
                future.release()
                yield index, result
        except distributed.KilledWorker as error:
            raise InputError(
                f"workers of {address} died again and again on the same part, most likely for want "
                "of memory. Finished parts are kept: run the same command again with larger workers."
            ) from error
        except ModuleNotFoundError as error:
            raise InputError(
                f"a worker of {address} has no {error.name}. Install mwdcal there as here: "
                f"{extras.command(CLUSTER)}"
            ) from error
        except lost() as error:
            raise InputError(
                f"`scheduler` {address}: the scheduler no longer answers. Finished parts are kept: start it "
                "and its workers again, and run the same command."
            ) from error


def lost() -> tuple[type[BaseException], ...]:
    """Errors where a scheduler has gone or is mute; without a cluster nothing loads `asyncio`, 20 ms."""
    import asyncio

    return OSError, TimeoutError, CancelledError, asyncio.CancelledError


def _finished(client: Any, waiting: Mapping[str, tuple[int, Any]]) -> Iterator[str]:
    """Keys of futures as they end; raises one of `lost` where the scheduler has fallen silent."""
    ended: SimpleQueue[str] = SimpleQueue()
    for _, future in list(waiting.values()):
        future.add_done_callback(lambda each: ended.put(each.key))
    while waiting:
        try:
            yield ended.get(timeout=CLUSTER_TIMEOUT)
        except Empty:
            client.sync(client.scheduler.identity, callback_timeout=CLUSTER_TIMEOUT)


@contextmanager
def _connected(distributed: Any, address: str) -> Iterator[Any]:
    """A client of a cluster that has a worker."""
    for name in list(logging.root.manager.loggerDict):
        if name.startswith("distributed"):
            logging.getLogger(name).setLevel(
                logging.CRITICAL + 1
            )  # its tracebacks; errors are raised
    import asyncio

    try:
        asyncio.run(_greet(distributed, address))
        client = distributed.Client(address, timeout=CLUSTER_TIMEOUT)
    except Exception as error:
        insecure = address.startswith("tls") and not distributed.Security().require_encryption
        missing = "certificates in Dask's configuration (distributed.comm.tls), and " * insecure
        raise InputError(
            f"`scheduler` {address}: no Dask scheduler answers there ({str(error)[:120] or 'it is mute'}). Start "
            f"one with {missing}`dask scheduler`, and workers with `dask worker ADDRESS`."
        ) from error
    try:
        client.wait_for_workers(1, timeout=CLUSTER_TIMEOUT)
        yield client
    except TimeoutError as error:
        raise InputError(
            f"`scheduler` {address}: the scheduler has no workers. Start some: dask worker {address}"
        ) from error
    finally:
        with suppress(*lost()):
            client.close(timeout=CLOSING)


async def _greet(distributed: Any, address: str) -> None:
    """Exchange greetings with a scheduler: a client waits without end for one that is mute."""
    import asyncio

    arguments = distributed.Security().get_connection_args("client")
    greeting = distributed.comm.connect(address, timeout=CLUSTER_TIMEOUT, **arguments)
    comm = await asyncio.wait_for(greeting, 2 * CLUSTER_TIMEOUT)
    await comm.close()
