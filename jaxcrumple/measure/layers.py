"""Stacking: how many layers of a crumpled sheet lie on top of one another, and how they are turned.

Cambou & Menon, PNAS 108 (2011) 14741, find that a sheet crumpled into a ball is locally ordered in parallel
stacks, which proceed inwards from its surface. The measures here are not theirs, which start from images: a
chord crosses a layer where it pierces a triangle. By `radial_profile` counts become functions of the radius.
A chord that meets an edge of the mesh to the last digit pierces both of its triangles.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcrumple.geometry.intersections import close_pairs, pierces
from jaxcrumple.measure.shells import center_of_mass, normals
from jaxcrumple.measure.strain import positions
from jaxcrumple.mesh.mesh import FloatArray, Mesh


def chord_layers(mesh: Mesh, x: ArrayLike, chords: ArrayLike) -> NDArray[np.intp]:
    """Number (k,) of layers that each of `chords` (k, 2, 3), from point to point in m, crosses at positions
    `x` (n, 3) in m. A chord along the normals of a stack counts its layers.

    **Raises:** ValueError for a wrong shape.
    """
    chords = np.asarray(chords, dtype=np.float64)
    if chords.ndim != 3 or chords.shape[1:] != (2, 3):
        raise ValueError(f"chords have shape {chords.shape}; give both ends of each, (k, 2, 3), in metres")
    return np.bincount(crossings(chords, positions(mesh, x)[mesh.faces])[:, 0], minlength=len(chords))


def stacked_layers(mesh: Mesh, x: ArrayLike, reach: float, *, limit_deg: float = 30.0) -> NDArray[np.intp]:
    """Number (f,) of layers in the stack at each face, its own included, at positions `x` (n, 3) in m.

    A chord goes from the middle of the face along its normal by `reach`, in m, to both sides. Of the layers
    that it crosses those count that are turned against the face by less than `limit_deg` degrees; a side of
    a sharp fold is a layer too. In an isotropic arrangement with an area A per volume, which has no stacks,
    the mean is $1 + A\\,r \\sin^2 \\alpha$ with the reach r and the limit $\\alpha$ up to 90 degrees.

    Time and memory grow with the third power of the reach: a few gaps between layers are meant, not the ball.

    **Raises:** ValueError for a wrong shape of `x`, a reach that is not positive, or a limit out of (0, 90].
    """
    if not 0 < reach < np.inf:
        raise ValueError(f"reach = {reach!r} is not usable; give a positive distance in metres")
    if not 0 < limit_deg <= 90:
        raise ValueError(f"limit_deg = {limit_deg!r} is not usable; give degrees above 0, at most 90")
    corners = positions(mesh, x)[mesh.faces]
    return 1 + parallel_crossings(corners, reach, np.cos(np.deg2rad(limit_deg)))


def radial_alignment(mesh: Mesh, x: ArrayLike) -> FloatArray:
    """Order parameter $(3 \\cos^2 \\beta - 1)/2$ (f,) of the angle $\\beta$ between the normal of a face and
    the direction from the centre of mass to its middle, at positions `x` (n, 3) in m.

    1 where layers lie around the centre as in an onion, -1/2 where they point at it; its mean over directions
    that are isotropic is 0.
    """
    corners = positions(mesh, x)[mesh.faces]
    outward = corners.mean(axis=1) - center_of_mass(mesh, x)
    distance = np.maximum(np.linalg.norm(outward, axis=1), np.finfo(float).tiny)
    return 1.5 * (np.einsum("fi,fi->f", normals(corners), outward) / distance) ** 2 - 0.5


def crossings(chords: FloatArray, corners: FloatArray) -> NDArray[np.intp]:
    """Pairs (m, 2) of one of `chords` (k, 2, 3) and a triangle of `corners` (f, 3, 3) that it pierces."""
    pairs = close_pairs(chords, corners)
    return pairs[pierces(chords[pairs[:, 0]], corners[pairs[:, 1]])]


def parallel_crossings(corners: FloatArray, reach: float, cosine: float) -> NDArray[np.intp]:
    """Number (f,) of other triangles that the chord through a triangle's middle, along its normal by `reach`
    to both sides, crosses, and whose normals make an angle with its own that has at least this `cosine`."""
    normal = normals(corners)
    chords = corners.mean(axis=1)[:, None] + reach * np.stack([-normal, normal], axis=1)
    one, two = crossings(chords, corners).T
    parallel = np.abs(np.einsum("mi,mi->m", normal[one], normal[two])) >= cosine
    return np.bincount(one[parallel & (one != two)], minlength=len(corners))
