"""A sheet that hardly differs from a flat one meets itself nowhere, which a look at each triangle tells.

Let the rest shape X lie over a convex part of a plane, with coordinates Y; let $J$ be the gradient of the
positions x by Y in a triangle (3x2), and $M$ (3x2) have orthonormal columns. On the straight line between two
points of the plane, in the direction $u$,
$$|x_2 - x_1| \\ge u \\cdot M^T (x_2 - x_1) = \\int u \\cdot M^T J u\\,ds \\ge \\lambda\\,|Y_2 - Y_1| \\ge
\\lambda\\,|X_2 - X_1| / \\Lambda,$$
with $\\lambda$ the least eigenvalue of the symmetric parts of all $M^T J$ and $\\Lambda$ the largest stretch
from Y to X. $\\lambda$ is concave in x, so on the straight way between two positions it is no less than at
one of them.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy.spatial import ConvexHull

from jaxcrumple.geometry.hinge import Vec, add, dot, gather, scale, sub
from jaxcrumple.mesh.mesh import Mesh

# By how much a rest shape may miss its convex hull in area, and its rim that of the hull, relative to the
# whole: far less than is left to spare of distances that matter.
ROUNDING = 1e-6


class Chart(eqx.Module):
    """Flat coordinates of a rest shape, $\\Lambda$ times as large.

    `faces` (f, 3); `inverse` (2, 2, f) 1/m: of the matrix of two edges of a triangle in these coordinates.
    """

    faces: Array
    inverse: Array

    def least(self, x: Array, frame: Array) -> Array:
        """Least ratio $\\lambda$ of a distance at positions `x` (n, 3) to that at rest, at least, as seen in
        the directions of `frame` (3, 2)."""
        one, two = self._gradients(x)
        m, n = tuple(frame[:, 0]), tuple(frame[:, 1])
        a, d, b = dot(m, one), dot(n, two), 0.5 * (dot(m, two) + dot(n, one))
        return jnp.min(0.5 * (a + d) - jnp.sqrt(0.25 * (a - d) ** 2 + b * b))

    def frame(self, x: Array) -> Array:
        """Two orthonormal directions (3, 2), next to the mean deformation gradient at positions `x` (n, 3);
        NaN where that is singular."""
        one, two = (jnp.stack([jnp.mean(part) for part in column]) for column in self._gradients(x))
        # The square root of a 2x2 matrix S is (S + sqrt(det S)) / sqrt(tr S + 2 sqrt(det S)).
        a, b, d = one @ one, one @ two, two @ two
        det = jnp.sqrt(a * d - b * b)
        root = jnp.stack([jnp.stack([a + det, b]), jnp.stack([b, d + det])]) / jnp.sqrt(a + d + 2.0 * det)
        (p, q), (_, r) = root
        return jnp.stack([one * r - two * q, two * p - one * q], axis=1) / (p * r - q * q)

    def _gradients(self, x: Array) -> tuple[Vec, Vec]:
        """The columns of J of each triangle."""
        first, second, third = gather(x, self.faces)
        along, across = sub(second, first), sub(third, first)
        inverse = self.inverse
        return (
            add(scale(inverse[0, 0], along), scale(inverse[1, 0], across)),
            add(scale(inverse[0, 1], along), scale(inverse[1, 1], across)),
        )


def build_chart(mesh: Mesh) -> Chart | None:
    """The chart of a mesh, or None where its rest shape does not lie over a convex part of a plane."""
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
