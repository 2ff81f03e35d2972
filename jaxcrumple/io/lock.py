"""File lock that allows one writer per run folder."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from jaxcrumple.io.atomic import RunDirectoryError, refusal

LOCK = ".lock"


@contextmanager
def writing(folder: Path, *, wait: bool = False) -> Iterator[None]:
    """Hold the lock of an existing run folder. Readers need no lock.

    The end of the process releases the lock. A thread that holds the lock may acquire it again. `wait`: wait
    for another writer to finish instead of raising an error.

    **Raises:** `RunDirectoryError` if another process or thread holds the lock.
    """
    try:
        # The singleton (one object per file and thread) counts acquisitions, so that the lock is reentrant.
        lock = FileLock(folder.absolute() / LOCK, is_singleton=True)
        lock.acquire(timeout=-1 if wait else 0)
    except Timeout as error:
        raise RunDirectoryError(
            f"another run is writing into {str(folder)!r}; wait until it ends, or stop it, then try again"
        ) from error
    except NotImplementedError as error:
        raise RunDirectoryError(f"{str(folder)!r} is on a file system without locks; {error}") from error
    except OSError as error:
        raise refusal(folder / LOCK, error) from error
    try:
        yield
    finally:
        lock.release()
