"""A surface as read from a file, and the errors and warnings of meshes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from itertools import chain
from typing import Any

import numpy as np
from jaxtyping import Float, Int, Real, Shaped


class MeshError(ValueError):
    """A surface that cannot be simulated. The message names the place and the cure."""


class MeshWarning(UserWarning):
    """A surface that can be simulated, but may not be the intended one."""


@dataclass(frozen=True, eq=False)
class Surface:
    """Polygons over points as in a file, with nothing dropped or merged.

    Polygon i has `sizes[i]` corners. In `corners` they follow the corners of polygon i - 1.
    """

    points: Float[np.ndarray, "points 3"]  # (m, 3)
    corners: Int[np.ndarray, " corners"]  # (sum of sizes,) rows of `points`
    sizes: Int[np.ndarray, " polygons"]  # (k,) at least 3
    data: Mapping[str, Shaped[np.ndarray, " ..."]] = field(default_factory=dict)  # further values per point


def surface_of(
    points: Any, polygons: Iterable[Any], data: Mapping[str, Shaped[np.ndarray, " ..."]] | None = None
) -> Surface:
    """Make a surface of polygons, which are sequences of rows of `points`, in the given order.

    Polygons with one or two corners are points and lines, and are omitted.

    **Raises:** `ValueError` if points are not (m, 2) or (m, 3) real numbers, or corners are not integers.
    """
    polygons = [polygon for polygon in polygons if len(polygon) > 2]
    sizes = np.array([len(polygon) for polygon in polygons], np.int64)
    corners = np.fromiter(chain.from_iterable(polygons), float, sizes.sum())
    if not np.array_equal(corners, np.rint(corners)):
        raise ValueError("its faces have corners that are not whole numbers")
    return Surface(spatial(points), corners.astype(np.int64), sizes, data or {})


def spatial(points: Any) -> Float[np.ndarray, "points 3"]:
    """Return points (m, 3); a missing third coordinate is 0."""
    raw = np.asarray(points, float)
    if raw.ndim != 2 or raw.shape[1] not in (2, 3):
        raise ValueError("it has no points with two or three coordinates")
    return np.column_stack([raw, np.zeros(len(raw))])[:, :3]


def strip_triangles(strip: Real[np.ndarray, " corners"]) -> Real[np.ndarray, "triangles 3"]:
    """Return the triangles (k - 2, 3) of a strip of k nodes, consistently oriented."""
    triangles = np.column_stack([strip[:-2], strip[1:-1], strip[2:]])
    triangles[1::2] = triangles[1::2, [1, 0, 2]]
    return triangles
