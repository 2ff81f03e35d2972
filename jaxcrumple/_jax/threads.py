"""Thread pools that must not fight: XLA's own, OpenBLAS (batched LAPACK) and MKL (sparse factors)."""

import importlib
import importlib.util
import os
from collections.abc import Iterator
from contextlib import contextmanager

from threadpoolctl import ThreadpoolController

# The variable by which MKL itself is told its number of threads.
VARIABLE = "MKL_NUM_THREADS"


@contextmanager
def limited_blas() -> Iterator[None]:
    """Hold OpenBLAS to one thread while inside, and MKL to as many as `MKL_NUM_THREADS` says, else to one.

    XLA calls LAPACK on small blocks from several of its own threads; if each call starts OpenBLAS's
    pool again they slow each other 10 to 200 times. MKL's threads wait for each other by spinning: on a
    machine that is not idle a step takes two to five times as long with two of them as with one. On
    one that is, two of them factor 12000 nodes in 0.7 of the time.

    **Raises:** ValueError for an `MKL_NUM_THREADS` that is not a positive integer.
    """
    threads = mkl_threads()
    # A pool can be held only once its library is loaded.
    if importlib.util.find_spec("pardiso_mkl_jax") is not None:
        importlib.import_module("pardiso_mkl_jax.primitive")
    pools = ThreadpoolController()
    with pools.select(internal_api="openblas").limit(limits=1), _limited_mkl(pools, threads):
        yield


def mkl_threads() -> int:
    """Threads that a sparse factor may use: `MKL_NUM_THREADS`, 1 where that is not set."""
    text = os.environ.get(VARIABLE, "1")
    if not (text.isdecimal() and int(text) > 0):
        raise ValueError(f"{VARIABLE}={text!r} in the environment must be a positive integer; or unset it.")
    return int(text)


@contextmanager
def _limited_mkl(pools: ThreadpoolController, threads: int) -> Iterator[None]:
    """Hold MKL for all threads; the limit that threadpoolctl sets holds for the calling one alone."""
    libraries = [(pool.dynlib, pool.num_threads) for pool in pools.select(internal_api="mkl").lib_controllers]
    for library, _ in libraries:
        library.MKL_Set_Num_Threads(threads)
    try:
        yield
    finally:
        for library, before in libraries:
            library.MKL_Set_Num_Threads(before)
