"""Triangulate polygons over their own corners."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxcrumple.mesh.files.surface import MeshError, Surface

_EQUAL = 1e-6  # relative difference below which two diagonals count as equal
_FLAT = 1e-9  # smallest area of an ear, relative to its longest side squared
_CROSSED = "face {} with {} corners crosses itself or has no area; remove or redraw it"
_MOST_CORNERS = 1000  # limit, because ear clipping tests every corner for every ear


def triangulated(surface: Surface) -> Int[np.ndarray, "triangles 3"]:
    """Cut the polygons of a surface into triangles (f, 3), in the order of the polygons.

    A quadrilateral is cut along its shorter diagonal, which gives better-shaped triangles, unless only the
    other one lies inside it. Of two equal diagonals, the one from the first corner is cut. A polygon with
    more corners loses its best-shaped ear until a triangle is left.

    **Raises:** `MeshError` naming a polygon that crosses itself or has too many corners.
    """
    surface = _without_repeats(surface)
    starts = np.cumsum(surface.sizes) - surface.sizes
    out = np.zeros((int((surface.sizes - 2).sum()), 3), np.int64)
    first = np.cumsum(surface.sizes - 2) - (surface.sizes - 2)
    for size in (3, 4):
        rows = np.flatnonzero(surface.sizes == size)
        polygons = surface.corners[starts[rows, None] + np.arange(size)]
        if size == 3:
            out[first[rows]] = polygons
        else:
            out[first[rows, None] + [0, 1]] = _cut(surface.points, polygons, rows)
    for row in np.flatnonzero(surface.sizes > 4):
        size = surface.sizes[row]
        polygon = surface.corners[starts[row] : starts[row] + size]
        if size > _MOST_CORNERS:
            raise MeshError(f"face {row} has {size} corners; cut it into triangles")
        ears = _ears(surface.points[polygon])
        if ears is None:
            raise MeshError(_CROSSED.format(row, size))
        out[first[row] : first[row] + size - 2] = polygon[ears]
    return out


def _without_repeats(surface: Surface) -> Surface:
    """Remove polygon corners that repeat the previous corner: some files write a triangle as a b c c."""
    owner = np.repeat(np.arange(len(surface.sizes)), surface.sizes)
    before = np.arange(len(owner)) - 1
    before[np.cumsum(surface.sizes) - surface.sizes] = np.cumsum(surface.sizes) - 1
    repeated = (surface.corners == surface.corners[before]) & (surface.sizes[owner] > 3)
    sizes = surface.sizes - np.bincount(owner[repeated], minlength=len(surface.sizes))
    bad = np.flatnonzero(sizes < 3)
    if len(bad):
        raise MeshError(_CROSSED.format(bad[0], surface.sizes[bad[0]]))
    return replace(surface, corners=surface.corners[~repeated], sizes=sizes)


def _cut(
    points: Float[np.ndarray, "points 3"], quads: Int[np.ndarray, "quads 4"], rows: Int[np.ndarray, " quads"]
) -> Int[np.ndarray, "quads 2 3"]:
    """Cut each quadrilateral into two triangles (q, 2, 3); `rows` are its polygon numbers for messages."""
    a, b, c, d = np.moveaxis(points[quads], 1, 0)

    def inside(
        p: Float[np.ndarray, "quads 3"],
        q: Float[np.ndarray, "quads 3"],
        r: Float[np.ndarray, "quads 3"],
        s: Float[np.ndarray, "quads 3"],
    ) -> Bool[np.ndarray, " quads"]:
        """Whether the triangles p q r and p r s, on either side of p r, do not overlap."""
        return (np.cross(q - p, r - p) * np.cross(r - p, s - p)).sum(axis=1) > 0

    one, two = np.linalg.norm(c - a, axis=1), np.linalg.norm(d - b, axis=1)
    first, second = inside(a, b, c, d), inside(b, c, d, a)
    bad = np.flatnonzero(~(first | second))
    if len(bad):
        raise MeshError(_CROSSED.format(rows[bad[0]], 4))
    other = np.where(first == second, two < one * (1 - _EQUAL), second)
    return quads[:, [[0, 1, 2], [0, 2, 3]]] * ~other[:, None, None] + (
        quads[:, [[1, 2, 3], [1, 3, 0]]] * other[:, None, None]
    )


def _ears(x: Float[np.ndarray, "corners 3"]) -> Int[np.ndarray, "ears 3"] | None:
    """Return triangles (k - 2, 3) of a polygon with corners `x` (k, 3), or None if it crosses itself."""
    following = np.roll(x, -1, axis=0)
    normal = np.cross(x - x[0], following - x[0]).sum(axis=0)  # Newell's normal: twice the area
    size = np.linalg.norm(normal)
    if size == 0:
        return None
    axis = np.argmax(np.abs(normal))
    flat = np.delete(x, axis, axis=1) * ([1, -1] if axis == 1 else [1, 1]) * [np.sign(normal[axis]), 1]
    left, ears = list(range(len(x))), []
    while len(left) > 2:
        ear = _best_ear(flat[left])
        if ear is None:
            return None
        ears.append([left[ear - 1], left[ear], left[(ear + 1) % len(left)]])
        del left[ear]
    return np.array(ears)


def _best_ear(p: Float[np.ndarray, "corners 2"]) -> int | None:
    """Return the corner with the best-shaped triangle inside a counterclockwise polygon (k, 2), or None."""
    before, after = np.roll(p, 1, axis=0), np.roll(p, -1, axis=0)
    doubled = _area(before, p, after)
    longest = np.max(
        [((q - r) ** 2).sum(axis=1) for q, r in ((p, before), (p, after), (before, after))], axis=0
    )
    quality = doubled / np.where(longest > 0, longest, 1)
    for corner in np.argsort(-quality, kind="stable"):
        if quality[corner] <= _FLAT:
            return None
        a, b, c = before[corner], p[corner], after[corner]
        # A corner on the cut would leave a polygon that touches itself, unless it is an end of the cut.
        others = (p != a).any(axis=1) & (p != b).any(axis=1) & (p != c).any(axis=1)
        q = p[others]
        within = (_area(a, b, q) >= 0) & (_area(b, c, q) >= 0) & (_area(c, a, q) >= 0)
        if not within.any():
            return int(corner)
    return None


def _area(
    a: Float[np.ndarray, "... 2"], b: Float[np.ndarray, "... 2"], c: Float[np.ndarray, "... 2"]
) -> Float[np.ndarray, " ..."]:
    """Twice the signed area of triangles in the plane."""
    u, v = b - a, c - a
    return u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]
