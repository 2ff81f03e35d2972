"""The paper's solver: conjugate gradients with Hilbert-ordered block-Jacobi blocks (Section 3.3)."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from jaxcrumple.model.pattern import Pattern
from jaxcrumple.solvers.cg import conjugate_gradients
from jaxcrumple.solvers.linear import AbstractLinearSolver, Factor, Solution, identity_values


class BlockCG(AbstractLinearSolver):
    """Preconditioned conjugate gradients that stop at negative curvature.

    Nodes are numbered along a Hilbert curve, so consecutive unknowns are neighbours in the sheet and
    dense diagonal blocks capture most of the matrix (Fig. 4).

    **Arguments:**

    - `block_size`: unknowns per dense block.
    - `max_iterations`: after which the last iterate is returned.
    """

    exact: ClassVar[bool] = False
    block_size: int = eqx.field(static=True, default=96)
    max_iterations: int = 20000

    def start(self, pattern: Pattern) -> Factor:
        """Blocks of the identity."""
        values = identity_values(pattern)
        return Factor(values, self._inverse_blocks(pattern, values)[0], jnp.asarray(0))

    def factor(self, pattern: Pattern, values: Array, previous: Factor) -> Factor:
        """Invert the diagonal blocks; one that is not positive definite proves the matrix indefinite."""
        inverse, sound = self._inverse_blocks(pattern, values)
        return Factor(values, inverse, jnp.where(sound, -1, 1))

    def _inverse_blocks(self, pattern: Pattern, values: Array) -> tuple[Array, Array]:
        size, total = self.block_size, pattern.diagonal.shape[0]
        count = -(-total // size)
        row, col = pattern.rows, pattern.indices
        block = row // size
        inside = block == col // size
        # Entries outside the blocks are sent out of bounds and dropped.
        flat = jnp.where(inside, (block * size + row % size) * size + col % size, count * size * size)
        upper = jnp.zeros(count * size * size).at[flat].set(values, mode="drop")
        upper = upper.reshape(count, size, size)
        tail = jnp.arange(count * size).reshape(count, size) >= total
        dense = upper + jnp.swapaxes(jnp.triu(upper, 1), 1, 2) + jax.vmap(jnp.diag)(tail.astype(float))
        factors = jnp.linalg.cholesky(dense)
        sound = jnp.all(jnp.isfinite(factors))
        identity = jnp.eye(size)
        inverse = jax.vmap(lambda c: jax.scipy.linalg.cho_solve((c, True), identity))(factors)
        return jnp.where(sound, inverse, identity), sound

    def solve(self, pattern: Pattern, factor: Factor, values: Array, rhs: Array, rtol: Array) -> Solution:
        """Conjugate gradients; `indefinite` is set when a direction of negative curvature appears."""
        total = rhs.shape[0]
        count = factor.workspace.shape[0]

        def precondition(r: Array) -> Array:
            padded = jnp.zeros(count * self.block_size).at[:total].set(r)
            blocks = padded.reshape(count, self.block_size)
            return jnp.einsum("bij,bj->bi", factor.workspace, blocks).reshape(-1)[:total]

        x, iterations, positive = conjugate_gradients(
            lambda d: pattern.product(values, d), precondition, rhs, rtol, self.max_iterations
        )
        return Solution(x, iterations, ~positive | (factor.negative > 0))
