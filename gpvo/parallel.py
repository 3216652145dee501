"""The same jobs on this machine's cores or on a Dask cluster."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from gpvo.errors import GpvoError, MissingExtraError


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
    ``on_done`` is called once per result, for progress bars.
    """
    if backend == "dask":
        return _told(_on_dask(function, jobs_arguments, scheduler), on_done)
    if backend != "local":
        raise GpvoError(f"unknown backend '{backend}'", cure="local or dask")
    if jobs == 1 or len(jobs_arguments) < 2:
        return _told((function(*arguments) for arguments in jobs_arguments), on_done)
    from joblib import Parallel, delayed

    calls = (delayed(function)(*arguments) for arguments in jobs_arguments)
    with warnings.catch_warnings():
        # A process that has grown is renewed between two jobs: nothing is lost, and nothing is to be done about it.
        warnings.filterwarnings("ignore", "A worker stopped while some jobs", UserWarning)
        return _told(Parallel(n_jobs=jobs, return_as="generator")(calls), on_done)


def _told(results: Iterable[Any], on_done: Callable[[], None]) -> list[Any]:
    out = []
    for result in results:
        out.append(result)
        on_done()
    return out


def _on_dask(
    function: Callable[..., Any], jobs_arguments: Sequence[tuple[Any, ...]], scheduler: str | None
) -> list[Any]:
    try:
        from distributed import Client
    except ImportError:
        raise MissingExtraError("distributed", "dask") from None
    try:
        client = Client(scheduler, timeout="10s") if scheduler else Client(processes=True, dashboard_address=None)
    except (OSError, TimeoutError, ValueError) as problem:
        raise GpvoError(f"no Dask scheduler answers: {problem}", where=scheduler, cure="dask scheduler") from None
    with client:
        futures = [client.submit(function, *arguments, pure=False) for arguments in jobs_arguments]
        return list(client.gather(futures))
