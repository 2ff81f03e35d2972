"""Thread pools that must not fight: XLA's own, OpenBLAS (batched LAPACK) and MKL."""

from collections.abc import Iterator
from contextlib import contextmanager

from threadpoolctl import ThreadpoolController


@contextmanager
def single_threaded_blas() -> Iterator[None]:
    """Hold OpenBLAS to one thread while inside.

    XLA calls LAPACK on small blocks from several of its own threads; if each call starts OpenBLAS's
    pool again they slow each other 10 to 200 times. MKL, which factors one large matrix, keeps its
    threads.
    """
    pools = ThreadpoolController().select(internal_api="openblas")
    with pools.limit(limits=1):
        yield
