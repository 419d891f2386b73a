"""Calls on a Dask cluster, of this machine's cores or a running one."""

from __future__ import annotations

import functools
import logging
import os
import signal
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from multiprocessing import resource_tracker
from typing import TYPE_CHECKING, Any

from allanjax.base.cache import enable_compilation_cache
from allanjax.base.errors import AllanjaxError

if TYPE_CHECKING:
    from distributed import Client, Future

# Time that a scheduler has to answer.
_CONNECT_SECONDS = 10


@contextmanager
def connected(scheduler: str | None, workers: int | None, tasks: int) -> Iterator[Client]:
    """Client of the cluster at an address, or of a local one that is closed after the tasks.

    Args:
        scheduler: address of a running scheduler, e.g. `tcp://host:8786`.
        workers: processes of the local cluster; by default one per core, but no more than tasks.
        tasks: how many tasks there will be.

    Raises:
        AllanjaxError: Dask is not installed, or the scheduler does not answer.
    """
    try:
        from dask.system import CPU_COUNT
        from distributed import Client, LocalCluster
    except ImportError as error:
        raise AllanjaxError('a fleet needs Dask: pip install "allanjax[fleet]"') from error
    if scheduler is not None:
        try:
            client = Client(scheduler, timeout=_CONNECT_SECONDS, set_as_default=False)
        except (OSError, ValueError) as error:
            raise AllanjaxError(
                f"no Dask scheduler answers at {scheduler!r}; check that it runs, and the address in "
                "scheduler= (--scheduler), e.g. tcp://host:8786"
            ) from error
        with client:
            yield client
        return
    with _interrupts_blocked():
        cluster = LocalCluster(
            n_workers=min(workers or CPU_COUNT, tasks),
            threads_per_worker=1,
            processes=True,
            dashboard_address="localhost:0",
            # A worker that dies is reported with its recording, or does no harm.
            silence_logs=logging.CRITICAL,
        )
    with cluster, Client(cluster, set_as_default=False) as client:
        yield client


@contextmanager
def _interrupts_blocked() -> Iterator[None]:
    """Make processes that are started now ignore Ctrl-C, which they would answer with a traceback each."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    # Started with the first process, the tracker would unblock the signal.
    resource_tracker.ensure_running()
    earlier = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, earlier)


Call = tuple[Callable[..., Any], Sequence[Any]]
"""A function that the workers can import, and its positional arguments; futures among them are waited for."""


def submitted(client: Client, call: Call) -> Future:
    """Future of a call on the cluster."""
    return client.submit(_call, *call, pure=False)


def outcomes(client: Client, calls: Mapping[str, Call]) -> Iterator[tuple[str, Any]]:
    """Make calls on the cluster.

    Args:
        client: client of the cluster.
        calls: the calls by their names.

    Yields:
        Name and result of each call as they end, or the exception it raised; `distributed.KilledWorker` if
        several workers died over it.
    """
    from distributed import KilledWorker, as_completed

    names = {submitted(client, call): name for name, call in calls.items()}
    blamed = []
    for future in as_completed(list(names), loop=client.loop):
        name = names.pop(future)
        outcome = _outcome(future)
        if isinstance(outcome, KilledWorker):
            blamed.append(name)
        else:
            yield name, outcome
    # If a worker dies, all its tasks are blamed. Tried again one by one, only the guilty task fails.
    for name in blamed:
        yield name, _outcome(submitted(client, calls[name]))


def _outcome(future: Any) -> Any:
    """Result of a future, or the exception that it raised."""
    try:
        return future.result()
    except Exception as error:
        return error


def _call(function: Callable[..., Any], arguments: Sequence[Any]) -> Any:
    """Make a call in a worker process."""
    _prepare_worker()
    return function(*arguments)


@functools.cache
def _prepare_worker() -> None:
    """Let the workers share compiled programs, and limit JAX's threads to this worker's cores."""
    from distributed import get_worker

    # Number of threads of XLA, which reads it when it first computes, after this.
    os.environ.setdefault("NPROC", str(get_worker().state.nthreads))
    enable_compilation_cache()
