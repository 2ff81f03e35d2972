"""Cross-sections: where a plane cuts the sheet (Fig. 8b)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcrumple.measure.shells import normals
from jaxcrumple.measure.strain import positions
from jaxcrumple.mesh.mesh import FloatArray, Mesh

_TRIANGLE = np.array([[0, 1], [1, 2], [2, 0]])
_PRISM = np.concatenate([_TRIANGLE, _TRIANGLE + 3, np.arange(6).reshape(2, 3).T])


class Section(NamedTuple):
    """The lines in which a plane cuts the triangles of a sheet."""

    faces: NDArray[np.intp]  # (s,) rows of the faces that are cut
    ends: FloatArray  # (s, 2, 2) both ends of each line, in m along the axes of the plane
    axes: FloatArray  # (2, 3) unit vectors of the plane, with the normal right-handed

    @property
    def length(self) -> float:
        """Total length of the lines [m]."""
        return float(np.linalg.norm(self.ends[:, 1] - self.ends[:, 0], axis=1).sum())


def cross_section(mesh: Mesh, x: ArrayLike, point: ArrayLike, normal: ArrayLike) -> Section:
    """The lines in which the plane through `point` (3,) in m with a `normal` (3,) of any length cuts the
    sheet at positions `x` (n, 3) in m. Ends of lines are measured from `point`.

    A corner in the plane counts as above it, so that lines are continuous and none is there twice.

    **Raises:** ValueError for a wrong shape or a normal without direction.
    """
    corners = positions(mesh, x)[mesh.faces]
    origin, axes = plane(point, normal)
    ends, cut = _cut(corners - origin, _TRIANGLE, axes)
    faces = np.flatnonzero(cut.any(axis=1))
    # Two sides of a triangle are cut: they come first when sorted.
    two = np.argsort(~cut[faces], axis=1, kind="stable")[:, :2, None]
    return Section(faces, np.take_along_axis(ends[faces], two, axis=1), axes)


def thick_section(
    mesh: Mesh, x: ArrayLike, thickness: float, point: ArrayLike, normal: ArrayLike
) -> FloatArray:
    """Outlines (s, 5, 2) in m of what a plane cuts of a sheet with its `thickness` in m.

    Each triangle is a prism that reaches by half of the thickness to both sides; prisms overlap on the inside
    of a fold and leave a wedge on its outside. The corners of an outline go round it, the last one repeated
    where there are fewer than five. Other arguments and errors as `cross_section`.
    """
    corners = positions(mesh, x)[mesh.faces]
    origin, axes = plane(point, normal)
    half = 0.5 * thickness * normals(corners)[:, None]
    points, cut = _cut(np.concatenate([corners - half, corners + half], axis=1) - origin, _PRISM, axes)
    points, cut = points[cut.any(axis=1)], cut[cut.any(axis=1)]
    middle = np.mean(points, axis=1, keepdims=True, where=cut[..., None])
    offset = points - middle
    around = np.where(cut, np.arctan2(offset[..., 1], offset[..., 0]), np.inf)
    order = np.argsort(around, axis=1)[:, :5]
    last = np.minimum(np.arange(5), cut.sum(axis=1, keepdims=True) - 1)
    return np.take_along_axis(points, np.take_along_axis(order, last, axis=1)[..., None], axis=1)


def plane(point: ArrayLike, normal: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """A point (3,) in m and unit vectors (2, 3) of the plane through it, x and y where its normal is z.

    **Raises:** ValueError for a wrong shape or a normal without direction.
    """
    origin, axis = np.asarray(point, dtype=np.float64), np.asarray(normal, dtype=np.float64)
    if origin.shape != (3,) or axis.shape != (3,):
        raise ValueError(f"point and normal have shapes {origin.shape} and {axis.shape}; give (3,) for both")
    size = np.linalg.norm(axis)
    if not 0 < size < np.inf:
        raise ValueError(f"normal = {axis.tolist()} has no direction; give a finite vector other than zero")
    axis = axis / size
    first = np.eye(3)[np.argmin(np.abs(axis))]
    first = first - (first @ axis) * axis
    first /= np.linalg.norm(first)
    return origin, np.stack([first, np.cross(axis, first)])


def _cut(vertices: FloatArray, edges: NDArray, axes: FloatArray) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Points (f, m, 2) where a plane through 0 cuts `edges` (m, 2) of bodies (f, v, 3), and which are cut."""
    height = vertices @ np.cross(*axes)
    low, high = height[:, edges[:, 0]], height[:, edges[:, 1]]
    cut = (low >= 0) != (high >= 0)
    at = np.divide(low, low - high, out=np.zeros_like(low), where=cut)[..., None]
    flat = vertices @ axes.T
    return flat[:, edges[:, 0]] * (1 - at) + flat[:, edges[:, 1]] * at, cut
