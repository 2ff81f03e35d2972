"""Run jobs in Dask worker processes: one per core of this machine, or on any Dask cluster."""

import logging
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager, suppress
from typing import Any

import cloudpickle
import jax
from distributed import Client, Future, Scheduler, SpecCluster, WorkerPlugin, wait
from distributed.deploy.subprocess import SubprocessWorker

from jaxcrumple.sweeps.errors import WorkersLostError

# A Dask cluster, a Dask client, the address of a scheduler, or None for workers on this machine.
Cluster = Any
# The future returns the exception of a job, so the worker need not log it.
_QUIET = logging.CRITICAL
# Workers on this machine listen only on its loopback address; LOCAL names their clusters.
HOST, LOCAL = "127.0.0.1", "jaxcrumple"
# Longest silence of a worker on this machine. It may be long, because an overloaded worker is silent too, and
# a closed connection reveals a worker that ended.
SILENCE = "365 days"
# Seconds between checks for workers on this machine, and number of consecutive checks without any worker
# after which they count as lost: Dask restarts a worker that ended, which takes a while.
LOOK, LOOKS = 10.0, 18
# Seconds to wait for the scheduler of a given cluster.
ANSWER = 20


# Part of the message of Dask if the scheduler lacks a package.
UNPACKED = "deserialization of the task graph"
SCHEDULER_LOST = (
    "the scheduler of the worker processes is gone: it was ended, or the connection was lost. Start again; "
    "what campaigns saved is kept."
)


class OneCore(WorkerPlugin):
    """Pin each worker to its own core, because XLA starts a thread for every core that it may use."""

    name = "one-core"

    def __init__(self, cores: Sequence[int]):
        self.cores = list(cores)

    def setup(self, worker: Any) -> None:
        """Pin the worker. Dask calls this at its start, before it creates threads."""
        os.sched_setaffinity(0, {self.cores[int(worker.name) % len(self.cores)]})


@contextmanager
def connected(cluster: Cluster, most: int) -> Iterator[Client]:
    """Yield a client of the cluster; for None, of at most `most` workers on this machine, one per core.

    Workers on this machine start as separate programs, so a script needs no `if __name__ == "__main__"`.

    **Raises:** ValueError if `cluster` is no cluster or does not answer; `WorkersLostError` if the scheduler
    is lost inside, or if workers cannot load this program.
    """
    if isinstance(cluster, Client):
        with _lost_workers_named():
            yield cluster
    elif cluster is not None:
        with _quiet(), _lost_workers_named(), _client(cluster) as client:
            yield client
    else:
        cores = _cores()
        with _lost_workers_named(), _local(min(len(cores), most)) as local, Client(local) as client:
            if hasattr(os, "sched_setaffinity"):
                client.register_plugin(OneCore(cores))
            yield client


def local_workers(cluster: Cluster, most: int) -> int:
    """Return the number of workers that `connected` starts on this machine and that share its memory. For a
    given cluster return one, because its machines are unknown."""
    return 1 if cluster is not None else min(len(_cores()), most)


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence the loggers of Dask inside: a lost scheduler raises an error and needs no logged traceback."""
    names = [name for name in logging.root.manager.loggerDict if name.split(".")[0] == "distributed"]
    levels = {name: logging.getLogger(name).level for name in names}
    for name in names:
        logging.getLogger(name).setLevel(_QUIET)
    try:
        yield
    finally:
        for name, level in levels.items():
            logging.getLogger(name).setLevel(level)


@contextmanager
def _lost_workers_named() -> Iterator[None]:
    """Explain the errors that Dask raises inside if its scheduler is lost or workers lack a package."""
    try:
        yield
    except CancelledError as error:
        raise WorkersLostError(SCHEDULER_LOST) from error
    except (ImportError, RuntimeError) as error:
        if isinstance(error, RuntimeError) and UNPACKED not in str(error):
            raise
        raise WorkersLostError(
            f"scheduler or workers cannot load this program ({str(error).splitlines()[0]}); install the same "
            "packages for them, in the same versions."
        ) from error


def _client(cluster: Cluster) -> Client:
    """Return a client of a given cluster.

    **Raises:** ValueError if no cluster answers.
    """
    try:
        return Client(cluster, timeout=ANSWER)
    except (OSError, TypeError, ValueError) as error:
        raise ValueError(
            f"cluster = {cluster!r} cannot be reached: {error}. Give a cluster or a client of Dask, or "
            "the address of a running scheduler, such as tcp://host:8786."
        ) from error


def _cores() -> list[int]:
    """Return the cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))


def _local(workers: int) -> SpecCluster:
    # Each worker has its own program cache: two workers that write one entry at once would damage it.
    cache = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]

    def worker(index: int) -> dict[str, Any]:
        environment = {"OMP_NUM_THREADS": "1"}
        if cache is not None:
            environment["JAX_COMPILATION_CACHE_DIR"] = os.path.join(cache, f"worker-{index}")
        options = {"nthreads": 1, "name": str(index), "memory_limit": 0, "env": environment}
        options |= {"host": HOST, "dashboard_address": f"{HOST}:0", "silence_logs": _QUIET}
        return {"cls": SubprocessWorker, "options": {"worker_kwargs": options}}

    scheduler = {"host": HOST, "port": 0, "dashboard": False, "dashboard_address": f"{HOST}:0"}
    scheduler["worker_ttl"] = SILENCE
    return SpecCluster(
        workers={index: worker(index) for index in range(workers)},
        scheduler={"cls": Scheduler, "options": scheduler},
        name=f"{LOCAL}-{os.getpid()}",
        silence_logs=_QUIET,
    )


def run_all(
    client: Client, function: Callable[..., Any], jobs: Sequence[tuple]
) -> Iterator[tuple[int, Future]]:
    """Yield the index of each job and the future of `function(*job)`, as they end.

    If a worker is lost, another one repeats its job. If the caller stops, this cancels all unfinished jobs.

    **Raises:** `WorkersLostError` if all workers of this machine, or the scheduler, are lost for good.
    """
    x64 = bool(jax.config.jax_enable_x64)  # type: ignore[attr-defined]
    # Serialise here: data that a worker cannot load then fails the job instead of ending the worker.
    packed = (cloudpickle.dumps((function, job)) for job in jobs)
    tasks = [client.submit(_task, data, sys.path, x64, pure=False) for data in packed]
    waiting = {task: index for index, task in enumerate(tasks)}
    gone = 0
    try:
        while waiting:
            ended = _ended(client, list(waiting))
            gone = 0 if ended or _has_workers(client) else gone + 1
            if gone == LOOKS:
                raise WorkersLostError(
                    "all worker processes are gone and none came back: something ended them, such as a "
                    "signal or a lack of memory. Start again; what campaigns saved is kept."
                )
            for future in ended:
                yield waiting.pop(future), future
                # Release a known result, so that Dask does not compute it again if its worker is lost.
                future.release()
    except CancelledError as error:
        raise WorkersLostError(SCHEDULER_LOST) from error
    finally:
        with suppress(Exception):  # A lost scheduler has nothing to cancel.
            client.cancel(list(waiting))


def _ended(client: Client, futures: list[Future]) -> list[Future]:
    """Return the futures that have ended; wait for at least one, or until LOOK seconds have passed."""
    try:
        return list(wait(futures, timeout=LOOK, return_when="FIRST_COMPLETED").done)
    except TimeoutError:
        return []


def _has_workers(client: Client) -> bool:
    """Return whether workers exist; always True for a given cluster, which may add workers at any time."""
    here = client.cluster is not None and client.cluster.name.startswith(LOCAL)
    return not here or bool(client.scheduler_info(n_workers=-1)["workers"])


def _task(data: bytes, path: Sequence[str], x64: bool) -> Any:
    """Run one job with the module path and the precision of the caller."""
    sys.path.extend(folder for folder in path if folder not in sys.path)
    jax.config.update("jax_enable_x64", x64)
    function, job = cloudpickle.loads(data)
    return function(*job)
