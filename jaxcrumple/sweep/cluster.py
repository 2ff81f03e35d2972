"""Worker processes: Dask's, one to a core of this machine, or of any cluster that Dask knows."""

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

# A cluster of Dask, a client of one, its scheduler's address, or None for workers on this machine.
Cluster = Any
# What a job raises comes back with it, and needs no line in a worker's log.
_QUIET = logging.CRITICAL
# Workers of this machine listen to it alone, in clusters of this name.
HOST, LOCAL = "127.0.0.1", "jaxcrumple"
# How long a worker of this machine may say nothing, as where there is too much to do: one that ended is known
# by its closed connection.
SILENCE = "365 days"
# Seconds between looks at whether workers of this machine are still there, and how many in a row that find
# none tell that they are gone for good: one that ended is started again, which takes a while.
LOOK, LOOKS = 10.0, 18
# Seconds to wait for a scheduler that is given by its address.
ANSWER = 20


# What Dask says of a scheduler that lacks a package.
UNPACKED = "deserialization of the task graph"
SCHEDULER_LOST = (
    "the scheduler of the worker processes is gone: something ended it, or cut the connection. Start again; "
    "what campaigns saved is kept."
)


class WorkersLostError(RuntimeError):
    """Worker processes, or their scheduler, that are gone for good, or cannot run this program."""


class OneCore(WorkerPlugin):
    """Holds each worker to a core of its own: XLA starts a thread for every core that it may use."""

    name = "one-core"

    def __init__(self, cores: Sequence[int]):
        self.cores = list(cores)

    def setup(self, worker) -> None:
        """Called by a worker that starts, before it has threads."""
        os.sched_setaffinity(0, {self.cores[int(worker.name) % len(self.cores)]})


@contextmanager
def connected(cluster: Cluster, most: int) -> Iterator[Client]:
    """A client of the cluster; of workers on this machine, one to a core and `most` of them, for None.

    These start as programs of their own, so that a script needs no guard around its main part.

    **Raises:** ValueError for what is no cluster, or does not answer; `WorkersLostError` for a scheduler that
    is lost inside, or workers that cannot load this program.
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
    """How many workers share this machine's memory, as `connected` starts them: one where a cluster is given,
    whose machines are not known."""
    return 1 if cluster is not None else min(len(_cores()), most)


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence Dask's loggers inside: a scheduler that is lost is raised, and needs no traceback beside."""
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
    """Say in words what Dask raises inside where its scheduler is gone, or workers lack a package."""
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
    """A client of a cluster that is not ours.

    **Raises:** ValueError where none answers.
    """
    try:
        return Client(cluster, timeout=ANSWER)
    except (OSError, TypeError, ValueError) as error:
        raise ValueError(
            f"cluster = {cluster!r} cannot be reached: {error}. Give a cluster or a client of Dask, or "
            "the address of a scheduler that runs, such as tcp://host:8786."
        ) from error


def _cores() -> list[int]:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))


def _local(workers: int) -> SpecCluster:
    # Workers share no cache of programs: two that write the same entry at once would damage it.
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
    """Futures of `function(*job)` that have ended, with the jobs' indices, as they end.

    What a lost worker was at is done again by another one. All that is unfinished is cancelled when the
    caller stops.

    **Raises:** `WorkersLostError` where workers of this machine are lost for good, or the scheduler is.
    """
    x64 = bool(jax.config.jax_enable_x64)  # type: ignore[attr-defined]
    # Packed here, so that what a worker cannot unpack is the job's error and not the worker's end.
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
                # A result that is known must not be made again when its worker is lost.
                future.release()
    except CancelledError as error:
        raise WorkersLostError(SCHEDULER_LOST) from error
    finally:
        with suppress(Exception):  # A scheduler that is gone has nothing to cancel.
            client.cancel(list(waiting))


def _ended(client: Client, futures: list[Future]) -> list[Future]:
    """Futures that have ended; waits for one, or for some time."""
    try:
        return list(wait(futures, timeout=LOOK, return_when="FIRST_COMPLETED").done)
    except TimeoutError:
        return []


def _has_workers(client: Client) -> bool:
    """Whether there are workers; those of other machines may come at any time."""
    here = client.cluster is not None and client.cluster.name.startswith(LOCAL)
    return not here or bool(client.scheduler_info(n_workers=-1)["workers"])


def _task(data: bytes, path: Sequence[str], x64: bool) -> Any:
    """One job, with the modules and in the precision of the caller."""
    sys.path.extend(folder for folder in path if folder not in sys.path)
    jax.config.update("jax_enable_x64", x64)
    function, job = cloudpickle.loads(data)
    return function(*job)
