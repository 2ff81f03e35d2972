"""What a file holds of a surface, and the errors and warnings of meshes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray


class MeshError(ValueError):
    """A surface that cannot be simulated. The message names the offender and the cure."""


class MeshWarning(UserWarning):
    """A surface that can be simulated, but perhaps is not the one that was meant."""


@dataclass(frozen=True, eq=False)
class Surface:
    """Polygons over points as a file has them, nothing dropped or merged.

    Polygon i has the `sizes[i]` corners that follow those of polygon i - 1 in `corners`.
    """

    points: NDArray[np.float64]  # (m, 3)
    corners: NDArray[np.int64]  # (sum of sizes,) rows of `points`
    sizes: NDArray[np.int64]  # (k,) at least 3
    data: Mapping[str, NDArray[Any]] = field(default_factory=dict)  # further values by point


def surface_of(
    points: Any, polygons: Iterable[Any], data: Mapping[str, NDArray[Any]] | None = None
) -> Surface:
    """A surface of polygons, sequences of rows of `points`, in the order given. Those with one or two corners
    are points and lines, and left out.

    **Raises:** `ValueError` for points that are not (m, 2) or (m, 3) real numbers, and for broken numbers.
    """
    polygons = [polygon for polygon in polygons if len(polygon) > 2]
    sizes = np.array([len(polygon) for polygon in polygons], np.int64)
    corners = np.fromiter(chain.from_iterable(polygons), float, sizes.sum())
    if not np.array_equal(corners, np.rint(corners)):
        raise ValueError("its faces have corners that are no whole numbers")
    return Surface(spatial(points), corners.astype(np.int64), sizes, data or {})


def spatial(points: Any) -> NDArray[np.float64]:
    """Points (m, 3); a missing third coordinate is 0."""
    raw = np.asarray(points, float)
    if raw.ndim != 2 or raw.shape[1] not in (2, 3):
        raise ValueError("it has no points with two or three coordinates")
    return np.column_stack([raw, np.zeros(len(raw))])[:, :3]


def strip_triangles(strip: NDArray[np.int64]) -> NDArray[np.int64]:
    """Triangles (k - 2, 3) of a strip of k nodes, equally oriented."""
    triangles = np.column_stack([strip[:-2], strip[1:-1], strip[2:]])
    triangles[1::2] = triangles[1::2, [1, 0, 2]]
    return triangles
