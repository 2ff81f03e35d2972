"""A CSV file that grows by whole rows and can be cut back to a known number of them."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import pandas as pd

from jaxcrumple.io.atomic import RunDirectoryError, refusal, write_bytes


class Table:
    """Rows at `path` under one header line. A last line cut short by a kill does not count as a row.

    No cell holds a line break, so a row is a line.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.count = max(len(self._lines()) - 1, 0)

    @property
    def columns(self) -> list[str]:
        """Names of the columns; empty before the first row."""
        if not self.path.is_file():
            return []
        with self.path.open(encoding="utf-8", newline="") as file:
            line = file.readline()
        return next(csv.reader([line])) if line.endswith("\n") else []

    def append(self, columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
        """Add `rows`; numbers keep all their digits.

        **Raises:** ValueError for other columns than before; `RunDirectoryError` if the file cannot be
        written, and then none of the rows is.
        """
        known = self.columns
        if known and known != list(columns):
            raise ValueError(f"{self.path.name} has the columns {known}, not {list(columns)}; keep them")
        lines = _csv(rows)
        count = lines.count(b"\n")
        if count == 0:
            return
        self._write(lines if known else _csv([columns]) + lines)
        self.count += count

    def extend_columns(self, columns: Sequence[str]) -> None:
        """Rewrite the file with further columns at the right, empty in the rows so far."""
        added = len(columns) - len(self.columns)
        rows = list(csv.reader(self._text().splitlines()))[1:]
        write_bytes(self.path, _csv([columns, *([*row, *[""] * added] for row in rows)]))

    def require(self, count: int) -> None:
        """**Raises:** `RunDirectoryError` if there are fewer than `count` rows."""
        if self.count < count:
            raise RunDirectoryError(
                f"{str(self.path)!r} has {self.count} rows but the checkpoint knows {count}; "
                "restore the file, or start the run again in a new folder"
            )

    def truncate(self, count: int) -> None:
        """Keep the first `count` rows. **Raises:** `RunDirectoryError` if there are fewer."""
        self.require(count)
        if count == 0:
            self._delete()
        else:
            write_bytes(self.path, b"".join(self._lines()[: count + 1]))
        self.count = count

    def read(self) -> pd.DataFrame:
        """All complete rows, every number as it was written; an empty frame before the first."""
        names, *rows = list(csv.reader(self._text().splitlines())) or [[]]
        cells = zip(*rows, strict=True) if rows else [()] * len(names)
        return pd.DataFrame({name: _typed(column) for name, column in zip(names, cells, strict=True)})

    def _text(self) -> str:
        return b"".join(self._lines()).decode()

    def _lines(self) -> list[bytes]:
        data = self.path.read_bytes() if self.path.is_file() else b""
        return data[: data.rfind(b"\n") + 1].splitlines(keepends=True)

    def _delete(self) -> None:
        try:
            self.path.unlink(missing_ok=True)
        except OSError as error:
            raise refusal(self.path, error) from error

    def _write(self, data: bytes) -> None:
        """Append `data` durably, or leave the file as it was."""
        try:
            with self.path.open("ab", buffering=0) as file:
                size = _complete_size(self.path, file.tell())
                file.truncate(size)
                try:
                    left = memoryview(data)
                    while left:  # a disk that becomes full takes a part first and complains then
                        left = left[file.write(left) :]
                    os.fsync(file.fileno())
                except OSError:
                    file.truncate(size)
                    raise
        except OSError as error:
            raise refusal(self.path, error) from error


def _complete_size(path: Path, size: int) -> int:
    """Bytes up to the last line break; reads the whole file only if its last line is cut."""
    if size == 0:
        return 0
    with path.open("rb") as file:
        file.seek(size - 1)
        if file.read(1) == b"\n":
            return size
    return path.read_bytes().rfind(b"\n") + 1


def _typed(cells: Sequence[str]) -> list[int] | list[float] | list[str | None]:
    """The cells of a column as integers, or numbers with NaN where empty, or text with None where empty."""
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
