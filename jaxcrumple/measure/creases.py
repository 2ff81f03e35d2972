"""Hinge angles, the map of mean curvature of Fig. 5a, and the plastic damage that makes creases.

Signs follow `jaxcrumple.mesh.mesh.Mesh`: an angle or curvature is positive where the sheet is convex seen
from the side to which the face normals point.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcrumple.measure.strain import check_finite, positions
from jaxcrumple.mesh.mesh import FloatArray, Mesh

#: A hinge is damaged if its rest curvature has moved by more than this. The smoothstep yield law leaks a
#: little below yield, so zero would count too much; see `crease_length` for the sensitivity.
DAMAGE = 0.05


def hinge_angles(mesh: Mesh, x: ArrayLike) -> FloatArray:
    """Signed angle (h,) in rad, in [-pi, pi], between the face normals of each hinge; `x` (n, 3) in m."""
    corners = positions(mesh, x)[mesh.hinges]
    e0, e1, e2 = (corners[:, k] - corners[:, 0] for k in (1, 2, 3))
    n1, n2 = np.cross(e0, e1), np.cross(e2, e0)
    # (n1 x n2).e0_hat = -|e0| (n2.e1), as in jaxcrumple.geometry.hinge.
    sine = -np.linalg.norm(e0, axis=1) * np.einsum("hi,hi->h", n2, e1)
    return np.arctan2(sine, np.einsum("hi,hi->h", n1, n2))


def hinge_curvature(mesh: Mesh, x: ArrayLike) -> FloatArray:
    """Dimensionless curvature (h,) $c = 2 \\sin(\\theta/2)$ of each hinge (eq. 33)."""
    return 2.0 * np.sin(0.5 * hinge_angles(mesh, x))


def mean_curvature(mesh: Mesh, x: ArrayLike) -> FloatArray:
    """Mean curvature (n,) $H = c_1 + c_2$ in 1/m at the nodes: 1/R on a cylinder, 2/R on a sphere.

    The integral of H over a hinge is $|e_0| \\theta$ (Cohen-Steiner & Morvan 2003, there for $H/2$); half of
    it goes to each end of the shared edge, and the sum is divided by the node's share of the area of its
    hinges. The share is circumcentric: $\\theta$ turns over the distance of the two circumcentres, so that
    a sphere is exact at every node, where thirds of triangles (`mesh.node_area`) miss by 15 % at a node with
    five neighbours.
    Lengths and areas are those of the rest shape, since the sheet hardly stretches. A node without hinges
    has H = 0.

    On a cylinder meshed at random the values scatter by 2 % in the interior and by about 100 % at the
    boundary, where a node sees only some of the directions.
    """
    ends = mesh.hinges[:, :2]
    integral = _to_nodes(ends, 0.5 * mesh.hinge_length * hinge_angles(mesh, x), mesh.n_nodes)
    area = _to_nodes(ends, _circumcentric_area(mesh), mesh.n_nodes)
    # Where triangles are so obtuse that little is left, or less than nothing, thirds of triangles stand in.
    area = np.maximum(area, _to_nodes(ends, mesh.hinge_area / 6.0, mesh.n_nodes) / 4.0)
    return np.divide(integral, area, out=np.zeros(mesh.n_nodes), where=area > 0)


def _circumcentric_area(mesh: Mesh) -> FloatArray:
    """Area (h,) in m2 between half of each shared edge and the two circumcentres; < 0 if not Delaunay."""
    x0, x1, *opposite = np.moveaxis(mesh.vertices[mesh.hinges], 1, 0)
    cotangents = sum(
        np.einsum("hi,hi->h", x0 - o, x1 - o) / np.linalg.norm(np.cross(x0 - o, x1 - o), axis=1)
        for o in opposite
    )
    return mesh.hinge_length**2 * cotangents / 8.0


def damaged(mesh: Mesh, p: ArrayLike, threshold: float = DAMAGE) -> NDArray[np.bool_]:
    """Which hinges (h,) have a rest curvature `p` (h,) that moved by more than `threshold`.

    **Raises:** ValueError for a threshold below 0, and as `plastic_curvature`.
    """
    if not threshold >= 0:
        raise ValueError(f"threshold = {threshold!r} must be zero or positive")
    return np.abs(plastic_curvature(mesh, p)) > threshold


def plastic_curvature(mesh: Mesh, p: ArrayLike) -> FloatArray:
    """Change (h,) of the rest curvature `p` (h,) since the sheet was new, dimensionless.

    **Raises:** ValueError unless `p` has one finite value for each hinge.
    """
    p = np.asarray(p, dtype=np.float64)
    if p.shape != mesh.rest_curvature.shape:
        raise ValueError(
            f"p has shape {p.shape}; give one rest curvature for each of {len(mesh.hinges)} hinges"
        )
    check_finite("p", p)
    return p - mesh.rest_curvature


def crease_pattern(mesh: Mesh, p: ArrayLike, threshold: float = DAMAGE) -> NDArray[np.int8]:
    """Sign (h,) of the creases: 1 where a damaged hinge's rest curvature `p` (h,) moved towards a mountain
    (convex seen from the side of the face normals), -1 towards a valley, 0 where it is not damaged."""
    return np.where(damaged(mesh, p, threshold), np.sign(plastic_curvature(mesh, p)), 0).astype(np.int8)


def mountain_valley_length(mesh: Mesh, p: ArrayLike, threshold: float = DAMAGE) -> tuple[float, float]:
    """Rest lengths in m of the mountains and valleys of `crease_pattern`, whose sum is `crease_length`."""
    pattern = crease_pattern(mesh, p, threshold)
    mountain, valley = (float(mesh.hinge_length[pattern == sign].sum()) for sign in (1, -1))
    return mountain, valley


def crease_length(mesh: Mesh, p: ArrayLike, threshold: float = DAMAGE) -> float:
    """Total rest length in m of the damaged hinges.

    It depends on the mesh: a straight crease of length L runs along a zig-zag of edges longer than L. Compare
    runs of one mesh size, and vary `threshold` to see how much the number owes to it.
    """
    return float(mesh.hinge_length[damaged(mesh, p, threshold)].sum())


def node_damage(mesh: Mesh, p: ArrayLike) -> FloatArray:
    """Largest $|p - p_{rest}|$ (n,) of the hinges whose shared edge ends at each node; 0 without hinges."""
    out = np.zeros(mesh.n_nodes)
    size = np.abs(plastic_curvature(mesh, p))
    for end in mesh.hinges[:, :2].T:
        np.maximum.at(out, end, size)
    return out


def folded_hinges(mesh: Mesh, x: ArrayLike, limit_deg: float = 170.0) -> int:
    """Number of hinges bent by more than `limit_deg` degrees either way; 180 is closed flat."""
    return int(np.count_nonzero(np.abs(hinge_angles(mesh, x)) > np.deg2rad(limit_deg)))


def _to_nodes(ends: NDArray, values: FloatArray, n: int) -> FloatArray:
    """Sum (n,) of hinge `values` (h,) over both `ends` (h, 2) of the shared edges."""
    return np.bincount(ends.ravel(), weights=np.repeat(values, 2), minlength=n).astype(float)
