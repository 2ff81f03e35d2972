"""BFGS updates of a lagged tangent (Matthies & Strang 1979): Newton's method with few factorisations.

Each change of the iterate, and the change of the residual that it caused, correct the inverse of an older
tangent. The last few of them are kept, newest first, and applied by two loops around one back substitution
(Nocedal & Wright, Numerical Optimization, algorithm 7.4).
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxcrumple._jax.arrays import Flag, NodeVectors, Scalar
from jaxcrumple._jax.tree import select

# Number of changes that are kept.
MOST = 5
# Least cosine between a change of the iterate and that of the residual: less is no curvature but rounding.
CURVED = 1e-8


class Secants(NamedTuple):
    """Hold changes of the iterate `moves` (k, n, 3) in m, those of the residual `forces` (k, n, 3) in N, and
    the inverses `weights` (k,) in 1/J of their products; a weight of 0 marks an empty place."""

    moves: Float[Array, "kept nodes 3"]
    forces: Float[Array, "kept nodes 3"]
    weights: Float[Array, " kept"]

    @classmethod
    def none(cls, n: int) -> "Secants":
        """Return empty places for `n` nodes."""
        return cls(jnp.zeros((MOST, n, 3)), jnp.zeros((MOST, n, 3)), jnp.zeros(MOST))

    @property
    def full(self) -> Flag:
        """Return whether no place is empty."""
        return jnp.all(self.weights != 0)

    def including(self, move: NodeVectors, force: NodeVectors, there: Flag) -> "Secants":
        """Return them with another one in front if it is `there`, and if the energy curves up along it."""
        product = jnp.vdot(move, force)
        curved = product > CURVED * jnp.sqrt(jnp.vdot(move, move) * jnp.vdot(force, force))
        more = Secants(
            jnp.concatenate([move[None], self.moves[:-1]]),
            jnp.concatenate([force[None], self.forces[:-1]]),
            jnp.concatenate([1.0 / product[None], self.weights[:-1]]),
        )
        return select(there & curved, more, self)

    def applied(self, solve: Callable[[NodeVectors], NodeVectors], force: NodeVectors) -> NodeVectors:
        """Return the product (n, 3) in m of the updated inverse with a `force` (n, 3) in N; `solve` applies
        the inverse of the older tangent."""

        def down(force: NodeVectors, secant: "Secants") -> tuple[NodeVectors, Scalar]:
            share = secant.weights * jnp.vdot(secant.moves, force)
            return force - share * secant.forces, share

        def up(move: NodeVectors, taken: tuple["Secants", Scalar]) -> tuple[NodeVectors, None]:
            secant, share = taken
            rest = share - secant.weights * jnp.vdot(secant.forces, move)
            return move + rest * secant.moves, None

        force, shares = jax.lax.scan(down, force, self)
        return jax.lax.scan(up, solve(force), (self, shares), reverse=True)[0]
