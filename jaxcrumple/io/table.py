"""A CSV file that grows by whole rows; its valid part is recorded in the manifest."""

from __future__ import annotations

import csv
import hashlib
import io
import os
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import pandas as pd

from jaxcrumple.io.atomic import RunDirectoryError, refusal
from jaxcrumple.io.manifest import EMPTY, Prefix


class TableFile:
    """The rows of a CSV file below its header line, up to the end of `prefix`; later bytes are ignored.

    No cell contains a line break, so each row is one line.
    """

    def __init__(self, path: Path, columns: Sequence[str], prefix: Prefix = EMPTY) -> None:
        self.path, self.columns, self._prefix = path, list(columns), prefix
        self._hash: Any = None  # hash of the valid bytes; None until they are read or written

    @property
    def prefix(self) -> Prefix:
        """The valid part of the table, for the manifest."""
        return self._prefix

    @property
    def count(self) -> int:
        """Number of rows."""
        return self._prefix.rows

    def append(self, rows: Iterable[Sequence[Any]]) -> None:
        """Append `rows`, after a header line if the table is empty; numbers keep all digits.

        **Raises:** `RunDirectoryError` if the file cannot be written (then no row is added), or if the
        existing rows are damaged.
        """
        lines = _csv(rows)
        count = lines.count(b"\n")
        if self._prefix.size == 0:
            lines = _csv([self.columns]) + lines
        if not lines:
            return
        running = self._checksum().copy()
        self._write(lines)
        running.update(lines)
        size, before, _ = self._prefix
        self._hash = running
        self._prefix = Prefix(size + len(lines), before + count, running.hexdigest())

    def check(self) -> None:
        """Verify the table. **Raises:** `RunDirectoryError` if its valid part is incomplete or changed."""
        self._data()

    def cut(self) -> None:
        """Remove the rows after the valid part. **Raises:** as `check`."""
        self._data()
        try:
            if self._prefix.size == 0:
                self.path.unlink(missing_ok=True)
            elif self.path.stat().st_size > self._prefix.size:
                with self.path.open("rb+") as file:
                    file.truncate(self._prefix.size)
                    os.fsync(file.fileno())
        except OSError as error:
            raise refusal(self.path, error) from error

    def read(self) -> pd.DataFrame:
        """Return all rows, with every number exactly as written. **Raises:** as `check`."""
        names, *rows = list(csv.reader(self._data().decode().splitlines())) or [self.columns]
        cells = zip(*rows, strict=True) if rows else [()] * len(names)
        return pd.DataFrame({name: _typed(column) for name, column in zip(names, cells, strict=True)})

    def _data(self) -> bytes:
        """Read the valid bytes and verify their checksum."""
        size, rows, sha256 = self._prefix
        if size == 0:
            return b""
        try:
            with self.path.open("rb") as file:
                data = file.read(size)
        except FileNotFoundError as error:
            raise RunDirectoryError(f"{str(self.path)!r} does not exist, but the run wrote it") from error
        except OSError as error:
            raise RunDirectoryError(f"{str(self.path)!r} cannot be read: {error.strerror}") from error
        if len(data) < size:
            raise RunDirectoryError(
                f"{str(self.path)!r} is cut short: the run wrote {size} bytes ({rows} rows), "
                f"the file has {len(data)}"
            )
        running = hashlib.sha256(data)
        if running.hexdigest() != sha256:
            raise RunDirectoryError(f"{str(self.path)!r} is damaged: its checksum does not match")
        self._hash = running
        return data

    def _checksum(self) -> Any:
        if self._hash is None:
            self._hash = hashlib.sha256(self._data())
        return self._hash

    def _write(self, data: bytes) -> None:
        """Write and sync `data` after the valid part; on failure leave the valid part unchanged."""
        size = self._prefix.size
        try:
            with self.path.open("ab", buffering=0) as file:
                if file.tell() < size:
                    raise RunDirectoryError(
                        f"{str(self.path)!r} was cut short while the run wrote to it; restore it from a copy"
                    )
                file.truncate(size)
                try:
                    left = memoryview(data)
                    while left:  # a disk that becomes full first writes a part, then raises an error
                        left = left[file.write(left) :]
                    os.fsync(file.fileno())
                except OSError:
                    file.truncate(size)
                    raise
        except OSError as error:
            raise refusal(self.path, error) from error


def _typed(cells: Sequence[str]) -> list[int] | list[float] | list[str | None]:
    """Convert a column to integers, else to floats (empty: NaN), else to text (empty: None)."""
    with suppress(ValueError):
        return [int(cell) for cell in cells]
    with suppress(ValueError):
        return [float(cell or "nan") for cell in cells]
    return [cell or None for cell in cells]


def _csv(rows: Iterable[Sequence[Any]]) -> bytes:
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    for row in rows:
        writer.writerow([_cell(value) for value in row])
    return buffer.getvalue().encode()


def _cell(value: Any) -> str:
    if value is None:
        return ""
    if hasattr(value, "item"):
        value = value.item()
    if isinstance(value, float):
        return repr(value)  # the shortest text that reads back as the same number
    return " ".join(str(value).split("\n")).replace("\r", " ")
