"""Prove that a nearly flat sheet has no self-contact, from the deformation gradients of its triangles.

Let the rest shape X project one-to-one onto a convex part of a plane, with coordinates Y. Let $J$ (3x2) be
the gradient of the positions x with respect to Y in a triangle, and let $M$ (3x2) have orthonormal columns.
On the straight line between two points of the plane, in the direction $u$,
$$|x_2 - x_1| \\ge u \\cdot M^T (x_2 - x_1) = \\int u \\cdot M^T J u\\,ds \\ge \\lambda\\,|Y_2 - Y_1| \\ge
\\lambda\\,|X_2 - X_1| / \\Lambda,$$
with $\\lambda$ the least eigenvalue of the symmetric parts of all $M^T J$ and $\\Lambda$ the largest stretch
from Y to X. $\\lambda$ is concave in x. On the straight path between two positions it is therefore no less
than the smaller of its two end values.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy.spatial import ConvexHull

from jaxcrumple.geometry.hinge import Vec, add, dot, gather, scale, sub
from jaxcrumple.mesh.mesh import Mesh

# Tolerance of the convexity test: relative difference of the area from that of the convex hull, and distance
# of boundary nodes from the hull over the root of the area. Far below the margin of `energy.APART`.
ROUNDING = 1e-6


class Chart(eqx.Module):
    """Hold the flat coordinates of a rest shape, multiplied by $\\Lambda$.

    `faces` (f, 3); `inverse` (2, 2, f) in 1/m: inverse of the matrix of two edges of each triangle in these
    coordinates.
    """

    faces: Array
    inverse: Array

    def least(self, x: Array, frame: Array) -> Array:
        """Return a lower bound of the ratio of any distance at positions `x` (n, 3) to that at rest.

        The bound is $\\lambda$ for $M$ = `frame` (3, 2), in the scaled coordinates.
        """
        one, two = self._gradients(x)
        m, n = tuple(frame[:, 0]), tuple(frame[:, 1])
        a, d, b = dot(m, one), dot(n, two), 0.5 * (dot(m, two) + dot(n, one))
        return jnp.min(0.5 * (a + d) - jnp.sqrt(0.25 * (a - d) ** 2 + b * b))

    def frame(self, x: Array) -> Array:
        """Return the orthonormal directions (3, 2) closest to the mean deformation gradient at `x` (n, 3).

        They are NaN if that gradient is singular.
        """
        one, two = (jnp.stack([jnp.mean(part) for part in column]) for column in self._gradients(x))
        # The square root of a 2x2 matrix S is (S + sqrt(det S)) / sqrt(tr S + 2 sqrt(det S)).
        a, b, d = one @ one, one @ two, two @ two
        det = jnp.sqrt(a * d - b * b)
        root = jnp.stack([jnp.stack([a + det, b]), jnp.stack([b, d + det])]) / jnp.sqrt(a + d + 2.0 * det)
        (p, q), (_, r) = root
        return jnp.stack([one * r - two * q, two * p - one * q], axis=1) / (p * r - q * q)

    def _gradients(self, x: Array) -> tuple[Vec, Vec]:
        """Return the two columns of J for each triangle."""
        first, second, third = gather(x, self.faces)
        along, across = sub(second, first), sub(third, first)
        inverse = self.inverse
        return (
            add(scale(inverse[0, 0], along), scale(inverse[1, 0], across)),
            add(scale(inverse[0, 1], along), scale(inverse[1, 1], across)),
        )


def build_chart(mesh: Mesh) -> Chart | None:
    """Build the chart of a mesh, or return None if its rest shape does not project one-to-one onto a convex
    part of a plane."""
    centred = mesh.vertices - mesh.vertices.mean(axis=0)
    axes = np.linalg.svd(centred, full_matrices=False)[2]
    flat, corners = centred @ axes[:2].T, centred[mesh.faces]
    edges = np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], axis=2)
    below = axes[:2] @ edges
    area = 0.5 * np.linalg.det(below)
    hull, whole = ConvexHull(flat), np.abs(area.sum())
    inside = -np.max(flat[mesh.boundary_nodes] @ hull.equations[:, :2].T + hull.equations[:, 2], axis=1)
    one_to_one = np.all(area > 0) or np.all(area < 0)
    convex = hull.volume < (1.0 + ROUNDING) * whole and inside.max() < ROUNDING * np.sqrt(whole)
    if not (one_to_one and convex):
        return None
    inverse = np.linalg.inv(below)
    stretch = np.linalg.norm(edges @ inverse, 2, axis=(1, 2)).max()
    return Chart(jnp.asarray(mesh.faces, jnp.int32), jnp.asarray(np.moveaxis(inverse / stretch, 0, 2)))
