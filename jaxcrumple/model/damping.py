"""Dissipation: isotropic drag (24) and dashpots along the edges (25).

In an implicit step, rates are differences over the step history. The central dashpot computes the rate
of its *length* from that history, $\\dot\\ell = (\\ell(x) + \\sum_j \\alpha_j \\ell(x_j))/(\\beta h)$. A
rigid rotation then produces no force at any step size, and the tangent is symmetric. Neither holds for
$\\hat r \\cdot v$ with $v$ from the same formula. The two rates agree to the order of the method.
"""

import abc
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxcrumple._jax.arrays import EdgeValues, NodeValues, NodeVectors, Scalar
from jaxcrumple.geometry.hinge import Vec, add, dot, gather, length, outer, scale, sub
from jaxcrumple.model.elements import scatter
from jaxcrumple.model.membrane import edge_blocks, edge_force


class Drag(eqx.Module):
    """Isotropic drag $F_i = -b_{iso} v_i$ (eq. 24); `coefficient` (n,) in kg/s."""

    coefficient: NodeValues

    def force(self, v: NodeVectors) -> NodeVectors:
        """Nodal forces (n, 3) in N at velocities `v` (n, 3)."""
        return -self.coefficient[:, None] * v


class AbstractDashpot(eqx.Module):
    """Internal damping. `memory` returns what an implicit step needs from the step history."""

    nodes: eqx.AbstractVar[Int[Array, "edges 2"]]
    coefficient: eqx.AbstractVar[EdgeValues]

    @abc.abstractmethod
    def force(self, x: NodeVectors, v: NodeVectors) -> NodeVectors:
        """Nodal forces (n, 3) in N at positions `x` and velocities `v` (n, 3)."""

    @abc.abstractmethod
    def memory(self, past: Float[Array, "points nodes 3"], alpha: Float[Array, " points"]) -> Any:
        """Summarise the step history: positions `past` (s, n, 3) in m with coefficients `alpha` (s,)."""

    @abc.abstractmethod
    def step_force(self, x: NodeVectors, v: NodeVectors, memory: Any, beta_h: Scalar) -> NodeVectors:
        """Nodal forces (n, 3) of an implicit step."""

    @abc.abstractmethod
    def step_blocks(
        self, x: NodeVectors, v: NodeVectors, memory: Any, beta_h: Scalar
    ) -> Float[Array, "3 3 3 edges"]:
        """Element tangents (3, 3, 3, e) of `step_force`, sign reversed."""


class CentralDashpot(AbstractDashpot):
    """Dashpots that resist the rate of change of edge lengths: always dissipative.

    **Arguments:** `nodes` (e, 2); `coefficient` (e,) $b_{int}$ in kg/s.
    """

    nodes: Int[Array, "edges 2"]
    coefficient: EdgeValues

    def force(self, x: NodeVectors, v: NodeVectors) -> NodeVectors:
        """Nodal forces (n, 3) in N: $-b\\, J^T J v$, $J = \\partial\\ell/\\partial x$."""
        r, u = _edge_vectors(x, v, self.nodes)
        return edge_force(self.nodes, r, self.coefficient * dot(r, u) / dot(r, r), x.shape[0])

    def memory(self, past: Float[Array, "points nodes 3"], alpha: Float[Array, " points"]) -> EdgeValues:
        """History part (e,) of the length rate, $\\sum_j \\alpha_j \\ell(x_j)$.

        `past` (s, n, 3) are the positions of the history, `alpha` (s,) their coefficients.
        """
        lengths = jax.vmap(lambda x: _edge_length(x, self.nodes))(past)
        return alpha @ lengths

    def _rate(self, x: NodeVectors, memory: EdgeValues, beta_h: Scalar) -> tuple[Vec, EdgeValues, EdgeValues]:
        xi, xj = gather(x, self.nodes)
        r = sub(xi, xj)
        edge = length(r)
        return r, edge, (edge + memory) / beta_h

    def step_force(self, x: NodeVectors, v: NodeVectors, memory: EdgeValues, beta_h: Scalar) -> NodeVectors:
        """Nodal forces (n, 3) of an implicit step."""
        r, edge, rate = self._rate(x, memory, beta_h)
        return edge_force(self.nodes, r, self.coefficient * rate / edge, x.shape[0])

    def step_blocks(
        self, x: NodeVectors, v: NodeVectors, memory: EdgeValues, beta_h: Scalar
    ) -> Float[Array, "3 3 3 edges"]:
        """Element tangents (3, 3, 3, e) of `step_force`, sign reversed."""
        r, edge, rate = self._rate(x, memory, beta_h)
        return edge_blocks(r, self.coefficient / beta_h, self.coefficient * rate / edge)


class PaperDashpot(AbstractDashpot):
    """The paper's internal damping $-b_{int}\\, d(r - s\\hat r)/dt$ (eq. 25).

    Not a central force: its transverse coefficient $b (1 - s/r)$ is negative in compressed springs.

    **Arguments:** `nodes` (e, 2); `coefficient` (e,) in kg/s; `rest_length` (e,) in m.
    """

    nodes: Int[Array, "edges 2"]
    coefficient: EdgeValues
    rest_length: EdgeValues

    def force(self, x: NodeVectors, v: NodeVectors) -> NodeVectors:
        """Nodal forces (n, 3) in N (A.5)."""
        r, u = _edge_vectors(x, v, self.nodes)
        pull = paper_dashpot_force(r, u, self.coefficient, self.rest_length)
        return scatter(self.nodes, (pull, scale(-1.0, pull)), x.shape[0])

    def memory(self, past: Float[Array, "points nodes 3"], alpha: Float[Array, " points"]) -> None:
        """Return None: this form uses the velocity itself and needs no history."""
        return None

    def step_force(self, x: NodeVectors, v: NodeVectors, memory: None, beta_h: Scalar) -> NodeVectors:
        """Nodal forces (n, 3) of an implicit step."""
        return self.force(x, v)

    def step_blocks(
        self, x: NodeVectors, v: NodeVectors, memory: None, beta_h: Scalar
    ) -> Float[Array, "3 3 3 edges"]:
        """Element tangents (3, 3, 3, e): (A.6) and, through $dv/dx = 1/(\\beta h)$, (A.7)."""
        r, u = _edge_vectors(x, v, self.nodes)
        edge = length(r)
        ru, inv = dot(r, u), 1.0 / (edge * edge)
        identity = jnp.eye(3)[:, :, None]
        turn = outer(r, u) + outer(u, r) - 3.0 * ru * inv * outer(r, r) + ru * identity
        by_x = self.coefficient * self.rest_length * inv / edge * turn
        bend = 1.0 - self.rest_length / edge
        by_v = self.coefficient * (bend * identity + (self.rest_length / edge * inv) * outer(r, r))
        block = by_x + by_v / beta_h
        return jnp.stack([block, -block, block])


def paper_dashpot_force(
    r: Vec, u: Vec, coefficient: Float[Array, " *axes"], rest_length: Float[Array, " *axes"]
) -> Vec:
    """Force on node i of an edge $r = x_i - x_j$ with relative velocity $u = v_i - v_j$ (eq. 25)."""
    edge = length(r)
    along = rest_length / edge**3 * dot(r, u)
    return scale(-coefficient, add(scale(1.0 - rest_length / edge, u), scale(along, r)))


def _edge_vectors(x: NodeVectors, v: NodeVectors, nodes: Int[Array, "edges 2"]) -> tuple[Vec, Vec]:
    (xi, xj), (vi, vj) = gather(x, nodes), gather(v, nodes)
    return sub(xi, xj), sub(vi, vj)


def _edge_length(x: NodeVectors, nodes: Int[Array, "edges 2"]) -> EdgeValues:
    xi, xj = gather(x, nodes)
    return length(sub(xi, xj))
