"""Atomic file writes: a kill or a full disk never leaves a partial file."""

from __future__ import annotations

import errno
import io
import json
import math
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Shaped

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_FORBIDDEN = (errno.EACCES, errno.EPERM, errno.EROFS)


class RunDirectoryError(ValueError):
    """A file or folder cannot be written or read. The message names the path, the cause and the cure."""


def refusal(path: Path, error: OSError) -> RunDirectoryError:
    """Return the error to raise for a failed write to `path`, with its cause and cure."""
    cause = os.strerror(error.errno) if error.errno else str(error)
    if error.errno in _FULL:
        cure = "free some space or choose an output folder on another disk; earlier data is intact"
    elif error.errno in _FORBIDDEN:
        cure = "choose a writable output folder, or change its permissions"
    elif error.errno in (errno.ENOENT, errno.ENOTDIR, errno.EEXIST):
        cure = "check the path: its folder must exist and be a folder"
    elif error.errno == errno.ENAMETOOLONG:
        cure = "give a shorter name"
    else:
        cure = "check the disk; earlier data is intact"
    return RunDirectoryError(f"cannot write {str(path)!r}: {cause}; {cure}")


def temporary(path: Path) -> Path:
    """Return the path that holds the partial data while `path` is written."""
    return path.with_name(f".{path.name}.tmp")


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path in the folder of `path`; on success, sync it and rename it to `path` atomically.

    On failure, remove the temporary file and leave `path` unchanged. A kill may leave the temporary file
    behind; its name is fixed, so the next write replaces it.

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


@contextmanager
def whole_folder(path: Path) -> Iterator[Path]:
    """Yield a new temporary folder beside `path`; on success, sync its files and rename it to `path`.

    On failure, remove it. A kill may leave it behind; its name is fixed, so the next attempt replaces it.

    **Raises:** `RunDirectoryError` for an OSError inside.
    """
    beginning = temporary(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if beginning.exists():
            shutil.rmtree(beginning)
        beginning.mkdir()
        yield beginning
        for part in beginning.rglob("*"):
            if part.is_file():
                _sync(part)
        os.rename(beginning, path)
        _sync_folder(path.parent)
    except BaseException as error:
        shutil.rmtree(beginning, ignore_errors=True)
        if isinstance(error, OSError):
            raise refusal(path, error) from error
        raise


def write_bytes(path: Path, data: bytes | memoryview) -> None:
    """Write `data` to `path` atomically. **Raises:** `RunDirectoryError`."""
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write(data)


def json_bytes(data: Mapping[str, Any]) -> bytes:
    """Encode `data` as a JSON file. `data` may contain NumPy numbers and arrays."""
    return (to_json(data, indent=2) + "\n").encode()


def npz_bytes(arrays: Mapping[str, Shaped[np.ndarray, " ..."]]) -> bytes:
    """Encode named arrays as an npz file."""
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)  # type: ignore[arg-type]
    return buffer.getvalue()


def to_json(data: Mapping[str, Any], indent: int | None = None) -> str:
    """Encode `data` as JSON text. JSON has no infinity or NaN: both become null.

    **Raises:** TypeError for a value without a JSON form.
    """
    return json.dumps(_plain(data), indent=indent, allow_nan=False)


def _plain(value: Any) -> Any:
    """Convert `value` to JSON types."""
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
    """Sync the folder so that the rename is durable. Only POSIX systems can open a folder."""
    if os.name != "posix":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def discard(path: Path) -> None:
    """Remove a file if it exists and can be removed."""
    try:
        path.unlink(missing_ok=True)
    except OSError:  # the folder is missing or is a file, so the file does not exist
        return
