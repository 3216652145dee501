"""The same jobs on this machine's cores or on a Dask cluster; items made ahead in a thread; what ends a process."""

from __future__ import annotations

import os
import signal
import threading
import time
import warnings
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from itertools import starmap
from typing import Any, TypeVar

from gpvo.errors import GpvoError, require

T = TypeVar("T")
_WATCH_S = 0.5
_KILLED = "a worker process was killed, as when memory runs out"


def ending_signals() -> list[int]:
    """Signals that end a process as Ctrl-C does: SIGTERM, and SIGHUP, of a terminal or a connection to it that is lost,
    unless it is to be ignored, as under ``nohup``."""
    lost: list[int] = [signal.SIGHUP] if hasattr(signal, "SIGHUP") else []  # not on Windows
    return [signal.SIGTERM, *(number for number in lost if signal.getsignal(number) is not signal.SIG_IGN)]


def after_first(number: int) -> signal.Handlers:
    """What a second signal of the kind does: it ends the process at once; but shell and kernel both say that a terminal
    is lost."""
    return signal.SIG_IGN if number == getattr(signal, "SIGHUP", None) else signal.SIG_DFL


def map_jobs(
    function: Callable[..., Any],
    jobs_arguments: Sequence[tuple[Any, ...]],
    *,
    jobs: int = 1,
    backend: str = "local",
    scheduler: str | None = None,
    on_done: Callable[[], None] = lambda: None,
) -> list[Any]:
    """``[function(*arguments) for arguments in jobs_arguments]``, in order, in parallel.

    ``backend`` "local": ``jobs`` processes (-1: all cores). "dask": the cluster at ``scheduler``, or one started here.
    ``on_done`` is called once per result, for progress bars. Raises GpvoError where a process is killed,
    and for no jobs, or a scheduler of no cluster.
    """
    if jobs == 0:
        raise GpvoError("there are 0 jobs to do it", cure="give --jobs 1 or more, or -1: one per core")
    if scheduler is not None and backend != "dask":
        raise GpvoError("--scheduler has no effect without --backend dask", cure="add --backend dask")
    if backend == "dask":
        return _told(_on_dask(function, jobs_arguments, scheduler), on_done)
    if backend != "local":
        raise GpvoError(f"unknown backend '{backend}'", cure="local or dask")
    if jobs == 1 or len(jobs_arguments) < 2:
        return _told(starmap(function, jobs_arguments), on_done)
    from concurrent.futures.process import BrokenProcessPool

    from joblib import Parallel, delayed

    # Of a process that a signal ends, workers and their tracker may both remove a semaphore: no matter to anybody.
    os.environ.setdefault("PYTHONWARNINGS", "ignore:resource_tracker:UserWarning")
    calls = (delayed(function)(*arguments) for arguments in jobs_arguments)
    with warnings.catch_warnings():
        # A process that has grown is renewed between two jobs: nothing is lost, and nothing is to be done about it.
        warnings.filterwarnings("ignore", "A worker stopped while some jobs", UserWarning)
        bound = {"initializer": _serve, "initargs": (os.getpid(),)}
        try:
            with _heeding_no_ctrl_c():
                results = Parallel(n_jobs=jobs, return_as="generator", **bound)(calls)
            return _told(results, on_done)
        except BrokenProcessPool:
            raise GpvoError(_KILLED, cure="run it again, with fewer --jobs") from None


@contextmanager
def _heeding_no_ctrl_c() -> Iterator[None]:
    """Until the end of the block, where workers are started: Ctrl-C reaches them too, and each that still loads what it
    runs on would print a traceback. They inherit that it has to wait."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    from multiprocessing import resource_tracker

    from joblib.externals.loky.backend import resource_tracker as of_workers

    for tracker in (resource_tracker, of_workers):
        tracker.ensure_running()  # which, if it were to begin inside, would let it through
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _serve(master: int) -> None:
    """Bind a worker to the process that made it. Ctrl-C reaches workers too, but the master alone heeds it, and ends
    them; where it is killed itself, they end instead of going on to write, and then waiting for minutes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def watch() -> None:
        while os.getppid() == master:
            time.sleep(_WATCH_S)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _told(results: Iterable[Any], on_done: Callable[[], None]) -> list[Any]:
    out = []
    for result in results:
        out.append(result)
        on_done()
    return out


def _on_dask(
    function: Callable[..., Any], jobs_arguments: Sequence[tuple[Any, ...]], scheduler: str | None
) -> list[Any]:
    require("distributed")
    from distributed import Client, KilledWorker

    try:
        client = Client(scheduler, timeout="10s") if scheduler else Client(processes=True, dashboard_address=None)
    except (OSError, TimeoutError, ValueError) as problem:
        raise GpvoError(f"no Dask scheduler answers: {problem}", where=scheduler, cure="run 'dask scheduler'") from None
    with client:
        futures = [client.submit(function, *arguments, pure=False) for arguments in jobs_arguments]
        try:
            return list(client.gather(futures))
        except KilledWorker:
            raise GpvoError(_KILLED, cure="run it again, with fewer workers") from None


def prefetched(items: Iterable[T]) -> Iterator[T]:
    """The same items, made ahead in one background thread; at most two wait.

    An exception in the thread is raised here; the thread ends when the consumer stops.
    """
    remaining = iter(items)
    end: Any = object()
    thread = ThreadPoolExecutor(1, "gpvo-decode")
    ahead = deque(thread.submit(next, remaining, end) for _ in range(2))
    try:
        while (item := ahead.popleft().result()) is not end:
            ahead.append(thread.submit(next, remaining, end))
            yield item
    finally:
        for future in ahead:
            future.cancel()
        # A generator's files belong to the thread: close them there, not wherever it is collected.
        if isinstance(items, Generator):
            with suppress(RuntimeError):  # at the end of the process no thread takes more
                thread.submit(items.close)
        thread.shutdown()
