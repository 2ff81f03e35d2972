"""Hinge angles, mean curvature (Fig. 5a), and creases, defined by plastic damage.

Signs follow `jaxcrumple.mesh.mesh.Mesh`: an angle or curvature is positive where the sheet is convex seen
from the side to which the face normals point.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxcrumple._jax.arrays import HingeValuesLike, NodeVectorsLike
from jaxcrumple.measure.strain import check_finite, positions
from jaxcrumple.mesh.mesh import Mesh

#: Change of the rest curvature above which a hinge is damaged. The smoothstep yield law flows slightly below
#: yield, so a threshold of zero would count too many hinges; see `crease_length` for the sensitivity.
DAMAGE = 0.05


def hinge_angles(mesh: Mesh, x: NodeVectorsLike) -> Float[np.ndarray, " hinges"]:
    """Return the signed angle (h,), -pi to pi rad, between the face normals of a hinge; `x` (n, 3) in m.

    It is positive where the sheet is convex seen from the side of the face normals.

    **Raises:** ValueError for a wrong shape of `x`.

    >>> square = jc.Mesh.from_arrays([[0, 0], [1, 0], [1, 1], [0, 1]], [[0, 1, 2], [0, 2, 3]])
    >>> folded = np.array([[0, 0, 0], [0.5, 0.5, 2**-0.5], [1, 1, 0], [0, 1, 0]])  # node 1 moved up
    >>> np.degrees(measure.hinge_angles(square, folded)).round(6)
    array([-90.])
    """
    corners = positions(mesh, x)[mesh.hinges]
    e0, e1, e2 = (corners[:, k] - corners[:, 0] for k in (1, 2, 3))
    n1, n2 = np.cross(e0, e1), np.cross(e2, e0)
    # (n1 x n2).e0_hat = -|e0| (n2.e1), as in jaxcrumple.geometry.hinge.
    sine = -np.linalg.norm(e0, axis=1) * np.einsum("hi,hi->h", n2, e1)
    return np.arctan2(sine, np.einsum("hi,hi->h", n1, n2))


def hinge_curvature(mesh: Mesh, x: NodeVectorsLike) -> Float[np.ndarray, " hinges"]:
    """Return the dimensionless curvature (h,) c = 2 sin(theta/2) of each hinge (eq. 33); `x` (n, 3) in m.

    **Raises:** ValueError for a wrong shape of `x`.

    >>> square = jc.Mesh.from_arrays([[0, 0], [1, 0], [1, 1], [0, 1]], [[0, 1, 2], [0, 2, 3]])
    >>> folded = np.array([[0, 0, 0], [0.5, 0.5, 2**-0.5], [1, 1, 0], [0, 1, 0]])  # node 1 moved up
    >>> measure.hinge_curvature(square, folded).round(4)  # a valley of 90 degrees
    array([-1.4142])
    """
    return 2.0 * np.sin(0.5 * hinge_angles(mesh, x))


def mean_curvature(mesh: Mesh, x: NodeVectorsLike) -> Float[np.ndarray, " nodes"]:
    """Return the mean curvature (n,) in 1/m at the nodes: 1/R on a cylinder, 2/R on a sphere.

    It is H = c1 + c2, the sum of the principal curvatures, at positions `x` (n, 3) in m. The integral of H
    over a hinge is the length of its edge times its angle theta (Cohen-Steiner & Morvan, Restricted Delaunay
    triangulations and normal cycle, SoCG 2003, there for H/2). Each end of the shared edge receives half of
    it. The sum at a node is divided by the circumcentric area of the node. The reason: theta turns over the
    distance between the two circumcentres, so that a sphere is exact at every node. With a third of each
    triangle (`mesh.node_area`) the error is 15 % at a node with five neighbours. Lengths and areas are those
    of the rest shape, since the sheet hardly stretches. A node without hinges has H = 0.

    On a random mesh of a cylinder the values scatter by 2 % in the interior and by about 100 % at the
    boundary, where the edges at a node do not cover all directions.

    **Raises:** ValueError for a wrong shape of `x`.
    """
    return curvature_of_angles(mesh, hinge_angles(mesh, x))


def curvature_of_angles(mesh: Mesh, angle: Float[np.ndarray, " hinges"]) -> Float[np.ndarray, " nodes"]:
    """Return the mean curvature (n,) in 1/m at the nodes, of hinge angles (h,) in rad."""
    ends = mesh.hinges[:, :2]
    integral = _to_nodes(ends, 0.5 * mesh.hinge_length * angle, mesh.n_nodes)
    area = _to_nodes(ends, _circumcentric_area(mesh), mesh.n_nodes)
    # Very obtuse triangles make this area small or negative; its lower bound is 1/4 of the barycentric area.
    area = np.maximum(area, _to_nodes(ends, mesh.hinge_area / 6.0, mesh.n_nodes) / 4.0)
    return np.divide(integral, area, out=np.zeros(mesh.n_nodes), where=area > 0)


def _circumcentric_area(mesh: Mesh) -> Float[np.ndarray, " hinges"]:
    """Return the area (h,) in m2 between half a shared edge and both circumcentres; < 0 if not Delaunay."""
    x0, x1, *opposite = np.moveaxis(mesh.vertices[mesh.hinges], 1, 0)
    cotangents = sum(
        np.einsum("hi,hi->h", x0 - o, x1 - o) / np.linalg.norm(np.cross(x0 - o, x1 - o), axis=1)
        for o in opposite
    )
    return mesh.hinge_length**2 * cotangents / 8.0


def damaged(mesh: Mesh, p: HingeValuesLike, threshold: float = DAMAGE) -> Bool[np.ndarray, " hinges"]:
    """Return a mask (h,) of the hinges whose rest curvature `p` (h,) changed by more than `threshold`.

    Both are dimensionless; the default threshold is `DAMAGE`. The flow of eq. 35 leaves small rest curvatures
    everywhere, so a threshold of 0 is not meaningful.

    **Raises:** ValueError for a threshold below 0, or a wrong shape of `p`.
    """
    if not threshold >= 0:
        raise ValueError(f"threshold = {threshold!r} must be zero or positive")
    return np.abs(plastic_curvature(mesh, p)) > threshold


def plastic_curvature(mesh: Mesh, p: HingeValuesLike) -> Float[np.ndarray, " hinges"]:
    """Return the change (h,) of the rest curvature `p` (h,) from the undeformed sheet, dimensionless.

    **Raises:** ValueError unless `p` has one finite value for each hinge.
    """
    p = np.asarray(p, dtype=np.float64)
    if p.shape != mesh.rest_curvature.shape:
        raise ValueError(
            f"p has shape {p.shape}; give one rest curvature for each of {len(mesh.hinges)} hinges"
        )
    check_finite("p", p)
    return p - mesh.rest_curvature


def crease_pattern(mesh: Mesh, p: HingeValuesLike, threshold: float = DAMAGE) -> Int[np.ndarray, " hinges"]:
    """Return the sign (h,) of the creases, from the rest curvature `p` (h,) of the hinges.

    1: mountain (convex seen from the side of the face normals), -1: valley, 0: hinge not damaged, by
    `threshold` as in `damaged`.

    **Raises:** ValueError as `damaged`.

    >>> mesh = jc.hexagonal(3, 2, 1e-3)
    >>> p = np.array([0.5, -0.5, 0.01, 0, 0, 0, 0, 0])
    >>> measure.crease_pattern(mesh, p)
    array([ 1, -1,  0,  0,  0,  0,  0,  0], dtype=int8)
    """
    return np.where(damaged(mesh, p, threshold), np.sign(plastic_curvature(mesh, p)), 0).astype(np.int8)


def mountain_valley_length(mesh: Mesh, p: HingeValuesLike, threshold: float = DAMAGE) -> tuple[float, float]:
    """Return the rest lengths in m of mountains and of valleys; their sum is `crease_length`.

    **Arguments:** `p` (h,) and `threshold` as in `damaged`.

    **Raises:** ValueError as `damaged`.
    """
    pattern = crease_pattern(mesh, p, threshold)
    mountain, valley = (float(mesh.hinge_length[pattern == sign].sum()) for sign in (1, -1))
    return mountain, valley


def crease_length(mesh: Mesh, p: HingeValuesLike, threshold: float = DAMAGE) -> float:
    """Return the total rest length in m of the damaged hinges.

    It depends on the mesh: a straight crease of length L follows a zig-zag of edges longer than L. Compare
    only runs with the same mesh size, and vary `threshold` to find the sensitivity.

    **Arguments:** `p` (h,) and `threshold` as in `damaged`.

    **Raises:** ValueError as `damaged`.

    >>> square = jc.Mesh.from_arrays([[0, 0], [1, 0], [1, 1], [0, 1]], [[0, 1, 2], [0, 2, 3]])
    >>> round(measure.crease_length(square, [0.5]), 4)  # m, along the diagonal
    1.4142
    >>> measure.crease_length(square, [0.5], threshold=0.6)
    0.0
    """
    return float(mesh.hinge_length[damaged(mesh, p, threshold)].sum())


def node_damage(mesh: Mesh, p: HingeValuesLike) -> Float[np.ndarray, " nodes"]:
    """Return the largest damage (n,) of the hinges whose shared edge ends at a node, or 0; dimensionless.

    The damage of a hinge is abs(p - p0), with its rest curvature `p` (h,) and that of the mesh, p0.

    **Raises:** ValueError for a wrong shape of `p`.
    """
    out = np.zeros(mesh.n_nodes)
    size = np.abs(plastic_curvature(mesh, p))
    for end in mesh.hinges[:, :2].T:
        np.maximum.at(out, end, size)
    return out


def folded_hinges(mesh: Mesh, x: NodeVectorsLike, limit_deg: float = 170.0) -> int:
    """Return the number of hinges that are folded by more than `limit_deg` degrees, at `x` (n, 3) in m.

    180 degrees is a fully closed fold.

    **Raises:** ValueError for a wrong shape of `x`, or a limit that is not between 0 and 180.
    """
    if not 0.0 <= limit_deg < 180.0:
        raise ValueError(f"limit_deg = {limit_deg} must be at least 0 and below 180 degrees.")
    return int(np.count_nonzero(np.abs(hinge_angles(mesh, x)) > np.deg2rad(limit_deg)))


def _to_nodes(
    ends: Int[np.ndarray, "hinges 2"], values: Float[np.ndarray, " hinges"], n: int
) -> Float[np.ndarray, " nodes"]:
    """Add hinge `values` (h,) to both `ends` (h, 2) of the shared edges: sums (n,) at the nodes."""
    return np.bincount(ends.ravel(), weights=np.repeat(values, 2), minlength=n).astype(float)
