"""Read OBJ and OFF files: one point or polygon per line."""

from __future__ import annotations

import re
from collections.abc import Iterator

from jaxcrumple.mesh.files.surface import Surface, surface_of

_OFF_HEADER = re.compile(r"(ST)?C?N?(4?)(n?)OFF\s*(BINARY)?", re.IGNORECASE)


def read_obj(content: bytes) -> Surface:
    """Read positions (`v`) and polygons (`f`) of a Wavefront OBJ file.

    It skips colours or a weight after a position, texture coordinates, normals, groups and materials.

    **Raises:** `ValueError` naming the line that cannot be read.
    """
    points: list[list[float]] = []
    polygons: list[list[int]] = []
    for number, line in _lines(content):
        key, *words = line.split()
        try:
            if key == "v":
                points.append(_position(words))
            elif key in ("f", "fo"):
                polygons.append([_row(word, len(points)) for word in words])
        except ValueError as error:
            raise ValueError(f"line {number}, {line[:60]!r}: {error}") from None
    return surface_of(points, polygons)


def read_off(content: bytes) -> Surface:
    """Read positions and polygons of an ASCII OFF file; skip colours, normals and texture coordinates.

    **Raises:** `ValueError` naming the line that cannot be read.
    """
    lines = _lines(content)
    _, first = next(lines, (0, ""))
    header = _OFF_HEADER.match(first)
    if header is None:
        raise ValueError("it does not begin with OFF")
    if header[2] or header[3] or header[4]:
        raise ValueError(f"its kind, {first[:60]!r}, has points of other dimensions or is binary")
    counts = first[header.end() :].split() or next(lines, (0, ""))[1].split()
    n, f = (int(count) for count in counts[:2])
    points: list[list[float]] = []
    polygons: list[list[int]] = []
    for number, line in lines:
        words = line.split()
        try:
            if len(points) < n:
                points.append(_position(words))
            elif len(polygons) < f:
                size = int(words[0])
                if not 0 <= size < len(words):
                    raise ValueError(f"{size} corners, but {len(words) - 1} numbers")
                polygons.append([int(word) for word in words[1 : size + 1]])
        except ValueError as error:
            raise ValueError(f"line {number}, {line[:60]!r}: {error}") from None
    if len(points) < n or len(polygons) < f:
        raise ValueError(f"it ends after {len(points)} of {n} points and {len(polygons)} of {f} faces")
    return surface_of(points, polygons)


def _lines(content: bytes) -> Iterator[tuple[int, str]]:
    """Yield number and text of each line without comments; a final backslash joins the next line."""
    begun = ""
    for number, line in enumerate(content.decode("utf-8-sig", errors="replace").splitlines(), 1):
        text = line.partition("#")[0].rstrip()
        if text.endswith("\\"):
            begun += text[:-1] + " "
            continue
        text, begun = (begun + text).strip(), ""
        if text:
            yield number, text
    if begun.strip():
        raise ValueError("it ends with a backslash, which continues a line")


def _position(words: list[str]) -> list[float]:
    if len(words) < 3:
        raise ValueError("a point needs three coordinates")
    return [float(word) for word in words[:3]]


def _row(word: str, count: int) -> int:
    """Return the point, from 0, of a corner such as 3, 3/1, 3//2 or -1 after `count` points."""
    number = int(word.partition("/")[0])
    if number == 0 or number < -count:
        raise ValueError("points are counted from 1, or backwards from -1")
    return number - 1 if number > 0 else count + number
