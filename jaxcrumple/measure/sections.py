"""Cross-sections of the sheet with a plane (Fig. 8b)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import ArrayLike, Bool, Float, Int, Real

from jaxcrumple._jax.arrays import NodeVectorsLike
from jaxcrumple._jax.tree import require_numbers
from jaxcrumple.measure.shells import normals
from jaxcrumple.measure.strain import positions
from jaxcrumple.mesh.mesh import Mesh

# A point or a direction as a user gives it.
Vector = Real[ArrayLike, " 3"] | Sequence[float]

_TRIANGLE = np.array([[0, 1], [1, 2], [2, 0]])
_PRISM = np.concatenate([_TRIANGLE, _TRIANGLE + 3, np.arange(6).reshape(2, 3).T])


class Section(NamedTuple):
    """Lines of intersection between a plane and the triangles of a sheet.

    - `faces` (s,): indices of the cut faces.
    - `ends` (s, 2, 2): both ends of each line, in m along the axes of the plane.
    - `axes` (2, 3): unit vectors in the plane, right-handed with the normal.
    """

    faces: Int[np.ndarray, " lines"]
    ends: Float[np.ndarray, "lines 2 2"]
    axes: Float[np.ndarray, "2 3"]

    @property
    def length(self) -> float:
        """Total length of the lines in m."""
        return float(np.linalg.norm(self.ends[:, 1] - self.ends[:, 0], axis=1).sum())


def cross_section(mesh: Mesh, x: NodeVectorsLike, point: Vector, normal: Vector) -> Section:
    """Cut the sheet at positions `x` (n, 3) in m with the plane through `point` (3,) in m.

    The `normal` (3,) of the plane may have any length. The line ends are relative to `point`. A corner in the
    plane counts as above it, so that lines are continuous and unique.

    **Raises:** ValueError for a wrong shape or a normal without direction.
    """
    corners = positions(mesh, x)[mesh.faces]
    origin, axes = plane(point, normal)
    ends, cut = _cut(corners - origin, _TRIANGLE, axes)
    faces = np.flatnonzero(cut.any(axis=1))
    # The plane cuts two sides of each triangle; the sort puts them first.
    two = np.argsort(~cut[faces], axis=1, kind="stable")[:, :2, None]
    return Section(faces, np.take_along_axis(ends[faces], two, axis=1), axes)


def thick_section(
    mesh: Mesh, x: NodeVectorsLike, thickness: float, point: Vector, normal: Vector
) -> Float[np.ndarray, "outlines 5 2"]:
    """Return the outlines (s, 5, 2) in m of the cut through a sheet of given `thickness` in m.

    Each triangle is a prism that extends half the thickness to both sides. Prisms overlap on the inside of a
    fold and leave a wedge on its outside. The corners of an outline are in cyclic order; an outline with
    fewer than five repeats the last one.

    **Arguments:** `x`, `point`, `normal` as in `cross_section`.

    **Raises:** ValueError as `cross_section`, or for a thickness that is not positive.
    """
    require_numbers("thickness", thickness, positive=True)
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


def plane(point: Vector, normal: Vector) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, "2 3"]]:
    """Return the point (3,) in m and two unit vectors (2, 3) in the plane; x and y for the normal z.

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


def _cut(
    vertices: Float[np.ndarray, "bodies corners 3"],
    edges: Int[np.ndarray, "edges 2"],
    axes: Float[np.ndarray, "2 3"],
) -> tuple[Float[np.ndarray, "bodies edges 2"], Bool[np.ndarray, "bodies edges"]]:
    """Cut `edges` (m, 2) of bodies (f, v, 3) with a plane through 0: points (f, m, 2), mask (f, m)."""
    height = vertices @ np.cross(*axes)
    low, high = height[:, edges[:, 0]], height[:, edges[:, 1]]
    cut = (low >= 0) != (high >= 0)
    at = np.divide(low, low - high, out=np.zeros_like(low), where=cut)[..., None]
    flat = vertices @ axes.T
    return flat[:, edges[:, 0]] * (1 - at) + flat[:, edges[:, 1]] * at, cut
