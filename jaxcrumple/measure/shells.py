"""Radial distribution of a crumpled sheet: triangle area in shells around the centre of mass.

The areas are exact for triangles of any size relative to the shells.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import ArrayLike, Complex, Float, Real

from jaxcrumple._jax.arrays import NodeVectorsLike
from jaxcrumple._jax.memory import require
from jaxcrumple.measure.strain import positions
from jaxcrumple.mesh.mesh import Mesh

_BYTES = 24.0  # per triangle and shell, with copies


def center_of_mass(mesh: Mesh, x: NodeVectorsLike) -> Float[np.ndarray, " 3"]:
    """Return the centre of mass (3,) in m of a sheet of uniform thickness at positions `x` (n, 3) in m.

    Each triangle has the mass of its rest area, evenly distributed.

    **Raises:** ValueError for a wrong shape of `x`.
    """
    return mesh.node_area @ positions(mesh, x) / mesh.node_area.sum()


def shell_areas(
    mesh: Mesh, x: NodeVectorsLike, radii: Real[ArrayLike, " bounds"] | Sequence[float]
) -> Float[np.ndarray, "faces shells"]:
    """Return the area (f, k) in m2 of each triangle in each of k shells around the centre of mass.

    **Arguments:** `x` (n, 3): positions in m, which define the areas; `radii` (k + 1,): bounds of the shells
    in m, ascending, the first >= 0.

    **Raises:** ValueError for a wrong shape of `x`, or if `radii` do not ascend.
    """
    radii = np.asarray(radii, dtype=np.float64)
    if radii.ndim != 1 or len(radii) < 2 or not (radii[0] >= 0 and np.all(np.diff(radii) > 0)):
        raise ValueError("radii do not bound shells; give two or more in metres, ascending from 0 or more")
    require_shells(mesh, len(radii) - 1)
    corners = (positions(mesh, x) - center_of_mass(mesh, x))[mesh.faces]
    return np.diff(area_within(corners, radii), axis=1)


def require_shells(mesh: Mesh, shells: int) -> None:
    """Refuse more shells than fit into memory. **Raises:** ValueError."""
    what = f"a table of {len(mesh.faces)} triangles in {shells} shells"
    require(_BYTES * len(mesh.faces) * shells, what, "choose fewer shells")


def radial_profile(
    mesh: Mesh,
    x: NodeVectorsLike,
    values: Real[ArrayLike, " faces"],
    radii: Real[ArrayLike, " bounds"] | Sequence[float],
) -> Float[np.ndarray, " shells"]:
    """Return the area-weighted mean (k,) of face `values` (f,) in each shell; nan in an empty shell.

    `x` (n, 3) and `radii` (k + 1,) in m as in `shell_areas`.

    **Raises:** as `shell_areas`, and ValueError unless there is one value per face.
    """
    values = np.asarray(values, dtype=np.float64)
    if values.shape != (len(mesh.faces),):
        raise ValueError(f"values have shape {values.shape}; give one for each of {len(mesh.faces)} faces")
    areas = shell_areas(mesh, x, radii)
    total = areas.sum(axis=0)
    return np.divide(values @ areas, total, out=np.full(len(total), np.nan), where=total > 0)


def normals(corners: Float[np.ndarray, "faces 3 3"]) -> Float[np.ndarray, "faces 3"]:
    """Return the unit normals (f, 3) of triangles `corners` (f, 3, 3); 0 for a triangle without area."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return _unit(normal)


def area_within(
    corners: Float[np.ndarray, "faces 3 3"], radii: Float[np.ndarray, " spheres"]
) -> Float[np.ndarray, "faces spheres"]:
    """Return the area (f, k) of triangles `corners` (f, 3, 3) within spheres of `radii` (k,) around 0.

    A sphere cuts the plane of a triangle in a disc. The common area of triangle and disc is a sum over the
    sides. Each term is the signed area between the side and the centre of the disc: a triangle for the part
    of the side inside the disc, a sector for the parts outside.
    """
    first = corners[:, 1] - corners[:, 0]
    normal = np.cross(first, corners[:, 2] - corners[:, 0])
    double = np.linalg.norm(normal, axis=1)
    u, n = _unit(first), _unit(normal)
    across = np.einsum("fci,fi->fc", corners, u), np.einsum("fci,fi->fc", corners, np.cross(n, u))
    height = np.einsum("fi,fi->f", corners[:, 0], n)
    plane = across[0] + 1j * across[1]
    areas = np.stack([_area_in_disc(plane, np.maximum(r**2 - height**2, 0.0)) for r in radii], axis=1)
    return np.clip(areas, 0.0, 0.5 * double[:, None])


def _area_in_disc(
    corners: Complex[np.ndarray, "faces 3"], squared: Float[np.ndarray, " faces"]
) -> Float[np.ndarray, " faces"]:
    """Return the area (f,) of triangles (complex `corners` (f, 3), counterclockwise) in discs.

    `squared` (f,): squares of the radii of the discs.
    """
    side = np.roll(corners, -1, axis=1) - corners
    length2 = np.maximum(np.abs(side) ** 2, np.finfo(float).tiny)
    along = (corners.conj() * side).real
    root = np.sqrt(np.maximum(along**2 - length2 * (np.abs(corners) ** 2 - squared[:, None]), 0.0))
    # Both ends of the part of each side in the disc. They coincide if no part is inside: only sectors remain.
    enter, leave = (corners + np.clip((s * root - along) / length2, 0.0, 1.0) * side for s in (-1, 1))
    angles = np.angle(corners.conj() * enter) + np.angle(leave.conj() * (corners + side))
    return 0.5 * np.sum(squared[:, None] * angles + (enter.conj() * leave).imag, axis=1)


def _unit(v: Float[np.ndarray, "vectors 3"]) -> Float[np.ndarray, "vectors 3"]:
    return v / np.maximum(np.linalg.norm(v, axis=1, keepdims=True), np.finfo(float).tiny)
