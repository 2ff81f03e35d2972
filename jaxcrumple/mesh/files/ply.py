"""Read PLY files: elements whose rows hold numbers and lists, as text or binary."""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from jaxcrumple.mesh.files.surface import Surface, strip_triangles, surface_of

_TYPES = {
    "char": "b",
    "int8": "b",
    "uchar": "B",
    "uint8": "B",
    "short": "h",
    "int16": "h",
    "ushort": "H",
    "uint16": "H",
    "int": "i",
    "int32": "i",
    "uint": "I",
    "uint32": "I",
    "int64": "q",
    "uint64": "Q",
    "float": "f",
    "float32": "f",
    "double": "d",
    "float64": "d",
}
_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
_END = re.compile(rb"[\r\n]end_header[ \t]*(?:\r\n|\r|\n|$)")
_CORNERS = ("vertex_indices", "vertex_index")


class _Unique(dict[str, Any]):
    """A dictionary that refuses a repeated name."""

    def __setitem__(self, name: str, value: Any) -> None:
        if name in self:
            raise ValueError(f"its header has {name[:40]!r} twice")
        super().__setitem__(name, value)


@dataclass
class _Element:
    """Rows of one kind: struct codes of each property's values and, for a list, of its length (else None)."""

    rows: int
    properties: dict[str, tuple[str, str | None]]


def read_ply(content: bytes) -> Surface:
    """Read vertices, faces and triangle strips of a PLY file; skip other elements and lists.

    **Raises:** `ValueError` for a file that is damaged or has no vertices.
    """
    kind, elements, body = _header(content)
    if kind == "ascii":
        # Convert text to a binary table of doubles, so that one parser reads both.
        body = np.array([float(word) for word in body.split()]).tobytes()
        for element in elements.values():
            element.properties = {
                name: ("d", count and "d") for name, (_, count) in element.properties.items()
            }
    tables, start = {}, 0
    for name, element in elements.items():
        tables[name], start = _table(name, element, body, start, _ORDERS[kind])
    vertices = tables.get("vertex", {})
    if not {"x", "y", "z"} <= vertices.keys():
        raise ValueError("it has no vertices with x, y and z")
    points = np.column_stack([vertices[axis] for axis in "xyz"])
    lists = {name for name, (_, count) in elements["vertex"].properties.items() if count}
    data = {name: values for name, values in vertices.items() if name not in {*"xyz", *lists}}
    return surface_of(points, _polygons(tables), data)


def _header(content: bytes) -> tuple[str, dict[str, _Element], bytes]:
    end = _END.search(content)
    if not content.startswith(b"ply") or end is None:
        raise ValueError("it has no header from ply to end_header")
    head, body = content[: end.start()], content[end.end() :]
    kind, elements, properties = "", _Unique(), _Unique()
    for line in head.decode("ascii", errors="replace").splitlines():
        words = line.split()
        match words:
            case ["format", kind, *_]:
                pass
            case ["element", name, rows]:
                properties = _Unique()
                elements[name] = _Element(int(rows), properties)
            case ["property", "list", count, code, name]:
                properties[name] = (_code(code), _code(count))
            case ["property", code, name]:
                properties[name] = (_code(code), None)
            case ["property", *_]:
                raise ValueError(f"its header has an unknown property {line[:60]!r}")
    if kind not in _ORDERS:
        raise ValueError(f"its format {kind!r} is unknown")
    return kind, elements, body


def _code(name: str) -> str:
    if name not in _TYPES:
        raise ValueError(f"its header has an unknown type {name[:40]!r}")
    return _TYPES[name]


def _table(name: str, element: _Element, body: bytes, start: int, order: str) -> tuple[dict[str, Any], int]:
    """Return values by property (arrays, or sequences for lists), and the start of the next element."""
    # A row takes at least one byte, so this check bounds the memory by the size of the file.
    if not 0 <= element.rows <= len(body) - start:
        raise ValueError(f"it ends before its {element.rows} rows of {name!r}")
    lengths = _first_lengths(element, body, start, order) if element.rows else {}
    dtype = np.dtype([part for key in element.properties for part in _fields(key, element, lengths, order)])
    end = start + element.rows * dtype.itemsize
    if end <= len(body) and dtype.itemsize and element.rows:
        table = np.frombuffer(body, dtype, element.rows, start)
        if all((table[f"# {key}"] == length).all() for key, length in lengths.items()):
            return {key: table[key] for key in element.properties}, end
    return _uneven(name, element, body, start, order)


def _fields(key: str, element: _Element, lengths: dict[str, int], order: str) -> list[Any]:
    code, count = element.properties[key]
    if count is None:
        return [(key, order + code)]
    return [(f"# {key}", order + count), (key, order + code, (lengths.get(key, 0),))]


def _first_lengths(element: _Element, body: bytes, start: int, order: str) -> dict[str, int]:
    """Return the lengths of the lists in the first row."""
    lengths = {}
    for key, (code, count) in element.properties.items():
        if count:
            lengths[key], start = _length(body, start, order, count, code)
            start += lengths[key] * struct.calcsize(order + code)
        else:
            start += struct.calcsize(order + code)
    return lengths


def _length(body: bytes, start: int, order: str, count: str, code: str) -> tuple[int, int]:
    """Return the length of a list, which must fit into the file, and the start of its values."""
    size = struct.calcsize(order + count)
    if start + size > len(body):
        raise ValueError("it ends within a list")
    length = struct.unpack_from(order + count, body, start)[0]
    room = (len(body) - start - size) // struct.calcsize(order + code)
    if not (0 <= length <= room and length == int(length)):
        raise ValueError(f"it has a list of {length} values where there is room for {room}")
    return int(length), start + size


def _uneven(name: str, element: _Element, body: bytes, start: int, order: str) -> tuple[dict[str, Any], int]:
    """Read an element row by row, for lists of different lengths; otherwise as `_table`."""
    table: dict[str, list[Any]] = {key: [] for key in element.properties}
    for _ in range(element.rows):
        for key, (code, count) in element.properties.items():
            length, start = _length(body, start, order, count, code) if count else (1, start)
            end = start + length * struct.calcsize(order + code)
            if end > len(body):
                raise ValueError(f"it ends before its {element.rows} rows of {name!r}")
            values = np.frombuffer(body, order + code, length, start)
            table[key].append(values if count else values[0])
            start = end
    lists = {key for key, (_, count) in element.properties.items() if count}
    return {key: rows if key in lists else np.array(rows) for key, rows in table.items()}, start


def _polygons(tables: dict[str, dict[str, Any]]) -> Iterator[Sequence[int]]:
    """Yield the faces, then the triangles of strips; -1 separates strips."""
    yield from next((tables["face"][key] for key in _CORNERS if key in tables.get("face", {})), [])
    strips = tables.get("tristrips", {})
    for row in next((strips[key] for key in _CORNERS if key in strips), []):
        values = np.asarray(row, np.int64)
        for strip in np.split(values, np.flatnonzero(values < 0)):
            yield from strip_triangles(strip[strip >= 0])
