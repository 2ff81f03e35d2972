"""In-plane elasticity: linear springs along the edges (Section 2.1)."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxcrumple._jax.arrays import EdgeValues, Flag, NodeVectors, Scalar
from jaxcrumple._jax.device import mapped
from jaxcrumple.geometry.hinge import Vec, add, dot, dyad, gather, length, scale, sub
from jaxcrumple.model.elements import scatter


def spring_energy(
    xi: Vec, xj: Vec, stiffness: Float[Array, " *axes"], rest_length: Float[Array, " *axes"]
) -> Float[Array, " *axes"]:
    """Energy of a spring, $\\frac12 k_s (|x_i - x_j| - s)^2$ (eq. 11), in J."""
    stretch = length(sub(xi, xj)) - rest_length
    return 0.5 * stiffness * stretch * stretch


def edge_force(nodes: Int[Array, "edges 2"], r: Vec, tension_per_length: EdgeValues, n: int) -> NodeVectors:
    """Nodal forces (n, 3) of edges that pull with `tension_per_length` times $r = x_i - x_j$."""
    pull = scale(tension_per_length, r)
    return scatter(nodes, (scale(-1.0, pull), pull), n)


def edge_blocks(r: Vec, axial: EdgeValues, tension_per_length: EdgeValues) -> Float[Array, "3 3 3 edges"]:
    """Element Hessians (3, 3, 3, e) of edges: $k\\,\\hat r\\hat r^T + (T/\\ell)(I - \\hat r\\hat r^T)$.

    `axial` is k and `tension_per_length` T/l; the three blocks are those of `upper_pairs(2)`.
    """
    direction = jnp.stack(r) / length(r)
    across = tension_per_length * jnp.eye(3).reshape(3, 3, *([1] * axial.ndim))

    def block(sign: Scalar) -> Float[Array, "3 3 edges"]:
        return sign * ((axial - tension_per_length) * dyad(direction, direction) + across)

    # As in `hinge_hessian`.
    return mapped(block, jnp.array([1.0, -1.0, 1.0]))


class Membrane(eqx.Module):
    """Springs on all edges.

    **Arguments:**

    - `nodes`: (e, 2) node numbers of the edges.
    - `stiffness`: (e,) spring constants $k_s$ in N/m.
    - `rest_length`: (e,) rest lengths $s_{ij}$ in m.
    """

    nodes: Int[Array, "edges 2"]
    stiffness: EdgeValues
    rest_length: EdgeValues

    def element_energy(self, x: NodeVectors) -> EdgeValues:
        """Energy of each edge (e,) in J at positions `x` (n, 3)."""
        xi, xj = gather(x, self.nodes)
        return spring_energy(xi, xj, self.stiffness, self.rest_length)

    def energy(self, x: NodeVectors) -> Scalar:
        """Stretching energy in J (eq. 11)."""
        return jnp.sum(self.element_energy(x))

    def strain(self, x: NodeVectors) -> EdgeValues:
        """Engineering strain of each edge (e,)."""
        xi, xj = gather(x, self.nodes)
        return length(sub(xi, xj)) / self.rest_length - 1.0

    def _edges(self, x: NodeVectors) -> tuple[Vec, EdgeValues]:
        xi, xj = gather(x, self.nodes)
        r = sub(xi, xj)
        return r, self.stiffness * (1.0 - self.rest_length / length(r))

    def force(self, x: NodeVectors) -> NodeVectors:
        """Nodal forces (n, 3) in N, closed form of minus the gradient of `energy` (A.1)."""
        r, tension_per_length = self._edges(x)
        return edge_force(self.nodes, r, tension_per_length, x.shape[0])

    def blocks(
        self, x: NodeVectors, taut: Flag | Bool[Array, " edges"] | None = None
    ) -> Float[Array, "3 3 3 edges"]:
        """Element Hessians (3, 3, 3, e) in N/m (A.3).

        If `taut` (bool) is true, compressed edges have no transverse stiffness, and each block is positive
        semidefinite.
        """
        r, tension_per_length = self._edges(x)
        if taut is not None:
            tension_per_length = jnp.where(taut & (tension_per_length < 0), 0.0, tension_per_length)
        return edge_blocks(r, self.stiffness, tension_per_length)

    def turning_force(self, x: NodeVectors, y: NodeVectors) -> NodeVectors:
        """Nodal forces (n, 3) in N from the nonlinear part of the edge elongations from `x` to `y`.

        The forces act along the edges at `x`. Edges that rotate on the straight path to `y` lengthen to
        second order in the displacement.
        """
        r, _ = self._edges(x)
        u = sub(*gather(y - x, self.nodes))
        old = length(r)
        growth = length(add(r, u)) - old - dot(r, u) / old
        return edge_force(self.nodes, r, self.stiffness * growth / old, x.shape[0])
