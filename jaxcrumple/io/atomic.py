"""Whole-file writes that a kill or a full disk cannot leave half done."""

from __future__ import annotations

import errno
import io
import json
import math
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_FORBIDDEN = (errno.EACCES, errno.EPERM, errno.EROFS)


class RunDirectoryError(ValueError):
    """A file or folder that cannot be written or read. The message names it, the cause and the cure."""


def refusal(path: Path, error: OSError) -> RunDirectoryError:
    """What to tell the user about a failed write to `path`."""
    cause = os.strerror(error.errno) if error.errno else str(error)
    if error.errno in _FULL:
        cure = "free some space or choose an output folder on another disk; what was saved before is intact"
    elif error.errno in _FORBIDDEN:
        cure = "choose an output folder you may write to, or change its permissions"
    elif error.errno in (errno.ENOENT, errno.ENOTDIR, errno.EEXIST):
        cure = "check the path: its folder must exist and be a folder"
    elif error.errno == errno.ENAMETOOLONG:
        cure = "give a shorter name"
    else:
        cure = "check the disk; what was saved before is intact"
    return RunDirectoryError(f"cannot write {str(path)!r}: {cause}; {cure}")


def temporary(path: Path) -> Path:
    """Where the beginning of a file is while it is written."""
    return path.with_name(f".{path.name}.tmp")


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path in the folder of `path`; on success it becomes `path`, durably and at once.

    On failure it is removed and `path` stays as it was. After a kill the temporary file may stay behind; its
    name is always the same, so the next write replaces it.

    **Raises:** `RunDirectoryError` for an OSError inside.
    """
    beginning = temporary(path)
    try:
        yield beginning
        _sync(beginning)
        os.replace(beginning, path)
        _sync_folder(path.parent)
    except BaseException as error:
        discard(beginning)
        if isinstance(error, OSError):
            raise refusal(path, error) from error
        raise


def write_bytes(path: Path, data: bytes | memoryview) -> None:
    """Write `data` to `path`, all or nothing. **Raises:** `RunDirectoryError`."""
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write(data)


def json_bytes(data: Mapping[str, Any]) -> bytes:
    """Contents of a JSON file of `data`, which may hold NumPy numbers and arrays."""
    return (to_json(data, indent=2) + "\n").encode()


def npz_bytes(arrays: Mapping[str, np.ndarray]) -> bytes:
    """Contents of an npz file of named arrays."""
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)  # type: ignore[arg-type]
    return buffer.getvalue()


def to_json(data: Mapping[str, Any], indent: int | None = None) -> str:
    """JSON text of `data`; JSON has no numbers that are not finite, so these become null.

    **Raises:** TypeError for what has no JSON form.
    """
    return json.dumps(_plain(data), indent=indent, allow_nan=False)


def _plain(value: Any) -> Any:
    """`value` in JSON types."""
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if hasattr(value, "tolist"):  # arrays and scalars of NumPy and JAX
        return _plain(value.tolist())
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, str | int):
        return value
    raise TypeError(
        f"{type(value).__name__} {value!r} has no JSON form; give numbers, strings, lists or dicts"
    )


def _sync(path: Path) -> None:
    with path.open("rb+") as file:
        os.fsync(file.fileno())


def _sync_folder(folder: Path) -> None:
    """Make the renaming itself durable, where the system lets folders be opened."""
    if os.name != "posix":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def discard(path: Path) -> None:
    """Remove a file that nobody needs, if it is there and can be removed."""
    try:
        path.unlink(missing_ok=True)
    except OSError:  # its folder is gone or no folder: nothing is left behind
        return
