"""Thread pools that must not fight: XLA's own, OpenBLAS (batched LAPACK) and MKL (sparse factors)."""

import importlib
import importlib.util
from collections.abc import Iterator
from contextlib import contextmanager

from threadpoolctl import ThreadpoolController


@contextmanager
def single_threaded_blas() -> Iterator[None]:
    """Hold OpenBLAS and MKL to one thread each while inside.

    XLA calls LAPACK on small blocks from several of its own threads; if each call starts OpenBLAS's
    pool again they slow each other 10 to 200 times. MKL's threads wait for each other by spinning: on a
    machine that is not idle a step takes two to five times as long with two of them as with one.
    """
    # A pool can be held only once its library is loaded.
    if importlib.util.find_spec("pardiso_mkl_jax") is not None:
        importlib.import_module("pardiso_mkl_jax.primitive")
    pools = ThreadpoolController()
    with pools.select(internal_api="openblas").limit(limits=1), _single_threaded_mkl(pools):
        yield


@contextmanager
def _single_threaded_mkl(pools: ThreadpoolController) -> Iterator[None]:
    """Hold MKL for all threads; the limit that threadpoolctl sets holds for the calling one alone."""
    libraries = [(pool.dynlib, pool.num_threads) for pool in pools.select(internal_api="mkl").lib_controllers]
    for library, _ in libraries:
        library.MKL_Set_Num_Threads(1)
    try:
        yield
    finally:
        for library, before in libraries:
            library.MKL_Set_Num_Threads(before)
