"""Stacking: number and orientation of the layers of a crumpled sheet.

Cambou & Menon, PNAS 108 (2011) 14741, find that a sheet crumpled into a ball is locally ordered in parallel
stacks, which extend inwards from its surface. Their measures use images; the measures here use chords: a
chord crosses a layer where it pierces a triangle. `radial_profile` converts face values to a function of the
radius. A chord that meets a mesh edge exactly pierces both triangles of the edge.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import ArrayLike, Float, Int, Real

from jaxcrumple._jax.arrays import NodeVectorsLike
from jaxcrumple.geometry.intersections import close_pairs, pierces
from jaxcrumple.measure.shells import center_of_mass, normals
from jaxcrumple.measure.strain import positions
from jaxcrumple.mesh.mesh import Mesh


def chord_layers(
    mesh: Mesh, x: NodeVectorsLike, chords: Real[ArrayLike, "chords 2 3"]
) -> Int[np.ndarray, " chords"]:
    """Return the number (k,) of layers that each chord crosses at positions `x` (n, 3) in m.

    `chords` (k, 2, 3): end points in m. A chord along the normal of a stack counts its layers.
    Cambou & Menon, PNAS 108 (2011) 14741, count layers in images instead.

    **Raises:** ValueError for a wrong shape.

    >>> square = jc.Mesh.from_arrays([[0, 0], [1, 0], [1, 1], [0, 1]], [[0, 1, 2], [0, 2, 3]])
    >>> chords = [[[0.7, 0.2, -1], [0.7, 0.2, 1]], [[1.5, 0.2, -1], [1.5, 0.2, 1]]]
    >>> measure.chord_layers(square, square.vertices, chords)
    array([1, 0]...)
    """
    chords = np.asarray(chords, dtype=np.float64)
    if chords.ndim != 3 or chords.shape[1:] != (2, 3):
        raise ValueError(f"chords have shape {chords.shape}; give both ends of each, (k, 2, 3), in metres")
    return np.bincount(crossings(chords, positions(mesh, x)[mesh.faces])[:, 0], minlength=len(chords))


def stacked_layers(
    mesh: Mesh, x: NodeVectorsLike, reach: float, *, limit_deg: float = 30.0
) -> Int[np.ndarray, " faces"]:
    """Return the number (f,) of layers in the stack at each face, itself included, at `x` (n, 3) in m.

    A chord extends from the middle of the face along its normal by `reach` (m) to both sides. It counts the
    layers that it crosses and whose angle to the face is less than `limit_deg` degrees; a side of a sharp
    fold counts as a layer. In an isotropic arrangement with area A per volume, without stacks, the mean is
    (1 + A r sin(alpha)^2) with the reach r and the limit alpha <= 90 degrees.

    Time and memory grow as the third power of `reach`: choose a few layer distances, not the ball size.

    **Raises:** ValueError for a wrong shape of `x`, a reach that is not positive, or a limit outside (0, 90].
    """
    if not 0 < reach < np.inf:
        raise ValueError(f"reach = {reach!r} is not usable; give a positive distance in metres")
    if not 0 < limit_deg <= 90:
        raise ValueError(f"limit_deg = {limit_deg!r} is not usable; give degrees above 0, at most 90")
    corners = positions(mesh, x)[mesh.faces]
    return 1 + parallel_crossings(corners, reach, np.cos(np.deg2rad(limit_deg)))


def radial_alignment(mesh: Mesh, x: NodeVectorsLike) -> Float[np.ndarray, " faces"]:
    """Return the orientational order parameter (f,) of the faces at positions `x` (n, 3) in m.

    It is (3 cos(beta)^2 - 1) / 2, where beta is the angle between the normal of a face and the direction from
    the centre of mass to the middle of the face. The value is 1 for concentric layers, as in an onion, and
    -1/2 for radial layers; the mean over isotropic directions is 0.

    **Raises:** ValueError for a wrong shape of `x`.
    """
    corners = positions(mesh, x)[mesh.faces]
    outward = corners.mean(axis=1) - center_of_mass(mesh, x)
    distance = np.maximum(np.linalg.norm(outward, axis=1), np.finfo(float).tiny)
    return 1.5 * (np.einsum("fi,fi->f", normals(corners), outward) / distance) ** 2 - 0.5


def crossings(
    chords: Float[np.ndarray, "chords 2 3"], corners: Float[np.ndarray, "faces 3 3"]
) -> Int[np.ndarray, "pairs 2"]:
    """Return pairs (m, 2): rows of `chords` (k, 2, 3), and triangles in `corners` (f, 3, 3) they pierce."""
    pairs = close_pairs(chords, corners)
    return pairs[pierces(chords[pairs[:, 0]], corners[pairs[:, 1]])]


def parallel_crossings(
    corners: Float[np.ndarray, "faces 3 3"], reach: float, cosine: float
) -> Int[np.ndarray, " faces"]:
    """Return the number (f,) of parallel triangles along the normal of each triangle.

    A chord extends from the middle of the triangle along its normal by `reach` to both sides. It counts other
    triangles that it crosses if the cosine of the angle between the normals is at least `cosine`.
    """
    normal = normals(corners)
    chords = corners.mean(axis=1)[:, None] + reach * np.stack([-normal, normal], axis=1)
    one, two = crossings(chords, corners).T
    parallel = np.abs(np.einsum("mi,mi->m", normal[one], normal[two])) >= cosine
    return np.bincount(one[parallel & (one != two)], minlength=len(corners))
