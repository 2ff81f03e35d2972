"""Read POLYDATA in VTK's legacy format, as text or binary, versions 1 to 5.1."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import ClassVar

import numpy as np
from jaxtyping import Real

from jaxcrumple.mesh.files.surface import Surface, strip_triangles, surface_of

_TYPES = {
    "unsigned_char": "u1",
    "char": "i1",
    "unsigned_short": "u2",
    "short": "i2",
    "unsigned_int": "u4",
    "int": "i4",
    "unsigned_long": "u8",
    "long": "i8",
    "vtkidtype": "i4",  # as VTK writes it in files of versions below 5
    "vtktypeint64": "i8",
    "float": "f4",
    "double": "f8",
}
_DATASET = re.compile(rb"^[ \t]*DATASET[ \t]+(\w+)", re.IGNORECASE | re.MULTILINE)


def is_polydata(content: bytes) -> bool:
    """Whether a legacy VTK file holds POLYDATA."""
    found = _DATASET.search(content[:10_000])
    return found is not None and found[1].upper() == b"POLYDATA"


def read_polydata(content: bytes) -> Surface:
    """Read points, polygons and triangle strips, and the scalars and fields of the points.

    **Raises:** `ValueError` for a file that is damaged.
    """
    return _Reader(content).surface()


class _Reader:
    """Reads the sections of a file one after another."""

    def __init__(self, content: bytes):
        self.content, self.at = content, 0
        version, _, kind = (self.line() for _ in range(3))
        number = re.search(r"Version\s+(\d+)", version)
        self.offsets = number is not None and int(number[1]) >= 5
        if kind.upper() not in ("ASCII", "BINARY"):
            raise ValueError(f"its third line is {kind[:40]!r} instead of ASCII or BINARY")
        self.binary = kind.upper() == "BINARY"
        self.points: Real[np.ndarray, "points 3"] = np.zeros((0, 3))
        self.polygons: list[Real[np.ndarray, " _"]] = []
        self.data: dict[str, Real[np.ndarray, " ..."]] = {}
        self.rows, self.of_points = 0, False

    def surface(self) -> Surface:
        """Read all sections."""
        while self.at < len(self.content):
            words = self.line().split()
            if words:
                section = self.SECTIONS.get(words[0].upper())
                if section is None:
                    raise ValueError(f"it has an unknown section {words[0][:40]!r}")
                section(self, words[1:])
        return surface_of(self.points, self.polygons, self.data)

    def line(self) -> str:
        """Read the next line."""
        end = self.content.find(b"\n", self.at)
        end = len(self.content) if end < 0 else end
        line, self.at = self.content[self.at : end], end + 1
        return line.decode("utf-8", errors="replace").strip()

    def array(self, count: int, type_name: str) -> Real[np.ndarray, " count"]:
        """Read the next `count` numbers; `type_name` is their type in binary files."""
        code = _TYPES.get(type_name.lower())
        if code is None:
            raise ValueError(f"it has numbers of the unknown type {type_name[:40]!r}")
        dtype = np.dtype(code).newbyteorder(">")
        size = dtype.itemsize if self.binary else 2  # a digit and a space
        if not 0 <= count * size <= len(self.content) - self.at + 1:
            raise ValueError(f"it ends before {count} numbers")
        if self.binary:
            end = self.at + count * size
            values = np.frombuffer(self.content[self.at : end], dtype)
            self.at = end + 1 if self.content[end : end + 1] == b"\n" else end
            return values
        words: list[bytes] = []
        while len(words) < count:
            if self.at >= len(self.content):
                raise ValueError(f"it ends after {len(words)} of {count} numbers")
            words += self.line().encode().split()
        if len(words) > count:
            raise ValueError(f"it has {len(words)} numbers instead of {count}")
        return np.array([float(word) for word in words])

    def _points(self, words: list[str]) -> None:
        self.points = self.array(3 * int(words[0]), words[1]).reshape(-1, 3)

    def _cells(self, words: list[str]) -> list[Real[np.ndarray, " _"]]:
        rows, numbers = int(words[0]), int(words[1])
        if self.offsets:
            bounds, corners = (self.array(size, self.line().split()[1]) for size in (rows, numbers))
        else:
            # The number of corners of each cell stands before them.
            values = self.array(numbers, "int").astype(np.int64)
            starts = [0]
            for _ in range(rows):
                if starts[-1] >= len(values) or values[starts[-1]] < 0:
                    raise ValueError(f"it has fewer than {rows} cells")
                starts.append(starts[-1] + 1 + int(values[starts[-1]]))
            bounds = np.array(starts) - np.arange(rows + 1)
            corners = np.delete(values, starts[:-1])
        if len(bounds) and (np.any(np.diff(bounds) < 0) or bounds[0] != 0 or bounds[-1] > len(corners)):
            raise ValueError("the offsets of its cells do not fit their corners")
        return np.split(corners, bounds[1:-1].astype(np.int64)) if len(bounds) > 1 else []

    def _polygons(self, words: list[str]) -> None:
        self.polygons += self._cells(words)

    def _strips(self, words: list[str]) -> None:
        for strip in self._cells(words):
            self.polygons += list(strip_triangles(strip))

    def _skipped_cells(self, words: list[str]) -> None:
        self._cells(words)

    def _metadata(self, words: list[str]) -> None:
        while self.at < len(self.content) and self.line():
            pass

    def _data(self, of_points: bool) -> Callable[[list[str]], None]:
        def begin(words: list[str]) -> None:
            self.rows, self.of_points = int(words[0]), of_points

        return begin

    def _keep(self, name: str, values: Real[np.ndarray, " ..."]) -> None:
        if self.of_points:
            self.data[name] = values

    def _scalars(self, words: list[str]) -> None:
        count = int(words[2]) if len(words) > 2 else 1
        before = self.at
        if not self.line().upper().startswith("LOOKUP_TABLE"):
            self.at = before
        values = self.array(self.rows * count, words[1])
        self._keep(words[0], values if count == 1 else values.reshape(-1, count))

    def _color_scalars(self, words: list[str]) -> None:
        self.array(self.rows * int(words[1]), "unsigned_char")

    def _lookup_table(self, words: list[str]) -> None:
        self.array(4 * int(words[1]), "unsigned_char")

    def _vectors(self, words: list[str]) -> None:
        self.array(3 * self.rows, words[1])

    def _tensors(self, words: list[str]) -> None:
        self.array(9 * self.rows, words[1])

    def _ids(self, words: list[str]) -> None:
        self.array(self.rows, words[1])

    def _texture_coordinates(self, words: list[str]) -> None:
        self.array(self.rows * int(words[1]), words[2])

    def _field(self, words: list[str]) -> None:
        for _ in range(int(words[1])):
            line: list[str] = []
            while not line and self.at < len(self.content):
                line = self.line().split()
                if line and line[0].upper() == "METADATA":
                    self._metadata(line)
                    line = []
            name, components, rows, type_name = line
            values = self.array(int(components) * int(rows), type_name)
            self._keep(name, values if components == "1" else values.reshape(int(rows), -1))

    SECTIONS: ClassVar[dict[str, Callable[[_Reader, list[str]], None]]] = {
        "DATASET": lambda self, words: None,
        "POINTS": _points,
        "POLYGONS": _polygons,
        "TRIANGLE_STRIPS": _strips,
        "VERTICES": _skipped_cells,
        "LINES": _skipped_cells,
        "METADATA": _metadata,
        "POINT_DATA": lambda self, words: self._data(True)(words),
        "CELL_DATA": lambda self, words: self._data(False)(words),
        "FIELD": _field,
        "SCALARS": _scalars,
        "COLOR_SCALARS": _color_scalars,
        "LOOKUP_TABLE": _lookup_table,
        "VECTORS": _vectors,
        "NORMALS": _vectors,
        "TENSORS": _tensors,
        "GLOBAL_IDS": _ids,
        "PEDIGREE_IDS": _ids,
        "TEXTURE_COORDINATES": _texture_coordinates,
    }
