"""Limits for thread pools that compete with XLA's: OpenBLAS (batched LAPACK) and MKL (sparse factors)."""

import importlib
import importlib.util
import os
from collections.abc import Iterator
from contextlib import contextmanager

from threadpoolctl import ThreadpoolController

# Environment variable from which MKL reads its number of threads.
VARIABLE = "MKL_NUM_THREADS"


@contextmanager
def limited_blas() -> Iterator[None]:
    """Limit OpenBLAS to one thread inside the context, and MKL to `MKL_NUM_THREADS` threads, by default 1.

    XLA calls LAPACK on small blocks from several of its own threads. If each call starts OpenBLAS's pool,
    the calls slow each other down 10 to 200 times. MKL's threads wait for each other by spinning: on a busy
    machine a step takes two to five times as long with two MKL threads as with one. On an idle machine, two
    threads factor 12000 nodes in 0.7 of the time.

    **Raises:** ValueError for an `MKL_NUM_THREADS` that is not a positive integer.
    """
    threads = mkl_threads()
    # threadpoolctl can limit a pool only after its library is loaded.
    if importlib.util.find_spec("pardiso_mkl_jax") is not None:
        importlib.import_module("pardiso_mkl_jax.primitive")
    pools = ThreadpoolController()
    with pools.select(internal_api="openblas").limit(limits=1), _limited_mkl(pools, threads):
        yield


def mkl_threads() -> int:
    """Return the number of threads for a sparse factorisation: `MKL_NUM_THREADS`, or 1 if it is not set."""
    text = os.environ.get(VARIABLE, "1")
    if not (text.isdecimal() and int(text) > 0):
        raise ValueError(f"{VARIABLE}={text!r} in the environment must be a positive integer; or unset it.")
    return int(text)


@contextmanager
def _limited_mkl(pools: ThreadpoolController, threads: int) -> Iterator[None]:
    """Limit MKL for all threads; threadpoolctl's limit holds for the calling thread only."""
    libraries = [(pool.dynlib, pool.num_threads) for pool in pools.select(internal_api="mkl").lib_controllers]
    for library, _ in libraries:
        library.MKL_Set_Num_Threads(threads)
    try:
        yield
    finally:
        for library, before in libraries:
            library.MKL_Set_Num_Threads(before)
