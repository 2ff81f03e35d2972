"""Distances between points, segments, triangles and boxes (Ericson, Real-Time Collision Detection, ch. 5).

Vectors are tuples of three arrays, as in `geometry.hinge`; all formulas broadcast. Clamps and minima replace
branches, so one kernel serves any number of pairs.
"""

from functools import reduce

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxcrumple._jax.arrays import Count, Scalar
from jaxcrumple._jax.device import mapped
from jaxcrumple.geometry.hinge import Vec, cross, dot, scale, sub

# Parts of two triangles: pairs corner-triangle as (side, corner), and pairs edge-edge as (edge, edge).
CORNERS = tuple((side, corner) for side in range(2) for corner in range(3))
EDGES = tuple((first, second) for first in range(3) for second in range(3))
# Corners at the ends of each edge of a triangle.
ENDS = ((0, 1), (1, 2), (2, 0))
# Squared sine below which two segments count as parallel; and an offset in m2, below any squared length here,
# that avoids 0/0.
PARALLEL, TINY = 1e-12, 1e-60


def segment_segment(p1: Vec, p2: Vec, q1: Vec, q2: Vec) -> Float[Array, "..."]:
    """Squared distance between the segments p1 p2 and q1 q2."""
    d1, d2, r = sub(p2, p1), sub(q2, q1), sub(p1, q1)
    a, e = dot(d1, d1) + TINY, dot(d2, d2) + TINY
    b, c, f = dot(d1, d2), dot(d1, r), dot(d2, r)
    determinant = a * e - b * b
    skew = determinant > PARALLEL * a * e
    s = jnp.where(skew, jnp.clip((b * f - c * e) / jnp.where(skew, determinant, 1.0), 0.0, 1.0), 0.0)
    t = jnp.clip((b * s + f) / e, 0.0, 1.0)
    s = jnp.clip((b * t - c) / a, 0.0, 1.0)
    d = sub(sub(r, scale(t, d2)), scale(-s, d1))
    return dot(d, d)


def point_plane(p: Vec, a: Vec, b: Vec, c: Vec) -> Float[Array, "..."]:
    """Squared distance of a point from the plane a b c if its foot lies in the triangle, else infinity."""
    e0, e1, r = sub(b, a), sub(c, a), sub(p, a)
    n = cross(e0, e1)
    area = dot(n, n) + TINY
    u, v = dot(cross(r, e1), n) / area, dot(cross(e0, r), n) / area
    height = dot(r, n)
    return jnp.where((u >= 0) & (v >= 0) & (u + v <= 1), height * height / area, jnp.inf)


def paired_corners(
    x: Float[Array, "nodes components"], first: Int[Array, "pairs 3"], second: Int[Array, "pairs 3"]
) -> Float[Array, "2 3 components pairs"]:
    """Corners (2, 3, c, m) of pairs of triangles with nodes `first`, `second` (m, 3): by triangle, corner and
    component; `x` (n, c): positions of the nodes, or other vectors."""
    return jnp.moveaxis(x.T[:, jnp.stack([first.T, second.T])], 0, 2)


def primitive_distances(sides: Float[Array, "2 3 3 *pairs"]) -> Float[Array, "15 *pairs"]:  # noqa: F821
    """Squared distances (15, ...) between the parts of two triangles, from `paired_corners` (2, 3, 3, ...).

    The first six are corner-triangle distances (`CORNERS`). They are infinite where the foot of the corner
    lies outside the triangle, because an edge is nearer then. The other nine are edge-edge distances
    (`EDGES`). Their minimum is the squared distance of triangles that do not intersect.
    """
    # XLA compiles the body of a loop once; fifteen expressions would take ten times as long.
    side, corner = np.array(CORNERS).T

    def above(part: tuple[Count, Count]) -> Float[Array, "..."]:
        point, triangle = sides[part[0], part[1]], sides[1 - part[0]]
        return point_plane(_vec(point), *map(_vec, triangle))

    def between(part: tuple[Int[Array, "2"], Int[Array, "2"]]) -> Float[Array, "..."]:
        (a, b), (c, d) = sides[0][part[0]], sides[1][part[1]]
        return segment_segment(_vec(a), _vec(b), _vec(c), _vec(d))

    one, two = np.array(EDGES).T
    ends = np.array(ENDS)
    corners = mapped(above, (jnp.asarray(side), jnp.asarray(corner)))
    edges = mapped(between, (jnp.asarray(ends[one]), jnp.asarray(ends[two])))
    return jnp.concatenate([corners, edges])


def _vec(a: Float[Array, "3 ..."]) -> Vec:
    return (a[0], a[1], a[2])


def shared_parts(first: Int[Array, "pairs 3"], second: Int[Array, "pairs 3"]) -> Bool[Array, "15 pairs"]:
    """Flags (15, m) of parts as in `primitive_distances` that share a node, from node numbers (m, 3)."""
    same = first.T[:, None] == second.T[None, :]
    return jnp.any(_owned()[..., None] & same, axis=(1, 2))


def _owned() -> Bool[np.ndarray, "15 3 3"]:
    """Flags of the pairs of corners of both triangles that belong to each part."""
    owned = np.zeros((len(CORNERS) + len(EDGES), 3, 3), bool)
    for part, (side, corner) in zip(owned, CORNERS, strict=False):
        (part if side == 0 else part.T)[corner] = True
    for part, (one, two) in zip(owned[len(CORNERS) :], EDGES, strict=True):
        part[np.ix_(ENDS[one], ENDS[two])] = True
    return owned


def boxes(corners: Float[Array, "faces 3 3"], extent: Float[Array, " faces"]) -> tuple[Vec, Vec]:
    """Bounding boxes of triangles with `corners` (f, 3, 3) that move by up to `extent` (f,).

    **Returns:** the lowest and the highest coordinates, three arrays (f,) each.
    """
    low, high = jnp.min(corners, axis=1) - extent[:, None], jnp.max(corners, axis=1) + extent[:, None]
    return (low[:, 0], low[:, 1], low[:, 2]), (high[:, 0], high[:, 1], high[:, 2])


def boxes_meet(
    low: Vec, high: Vec, one: Int[Array, " pairs"], two: Int[Array, " pairs"], range: Scalar
) -> Bool[Array, " pairs"]:
    """Whether boxes `one` (m,) and `two` (m,) are within `range` of each other along every axis."""
    apart = [jnp.maximum(a[one] - b[two], a[two] - b[one]) for a, b in zip(low, high, strict=True)]
    return reduce(jnp.maximum, apart) <= range
