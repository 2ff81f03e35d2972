"""The paper's solver: conjugate gradients with Hilbert-ordered block-Jacobi blocks (Section 3.3)."""

from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxcrumple._jax.arrays import Flag, Scalar
from jaxcrumple.assembly.sparsity import Pattern
from jaxcrumple.solvers.linear.base import AbstractLinearSolver, Factor, LinearSolution, identity_values
from jaxcrumple.solvers.linear.cg import conjugate_gradients


class BlockCG(AbstractLinearSolver):
    """Solve by preconditioned conjugate gradients, which stop at negative curvature.

    The node numbers follow a Hilbert curve. Consecutive unknowns are therefore neighbours in the sheet, and
    dense diagonal blocks contain most of the matrix (Fig. 4).

    **Arguments:**

    - `block_size`: unknowns per dense block.
    - `max_iterations`: largest number of iterations; the solver then returns the last iterate.
    """

    exact: ClassVar[bool] = False
    block_size: int = eqx.field(static=True, default=48)
    max_iterations: int = 20000

    def load_library(self) -> None:
        """Load LAPACK."""
        load_lapack()

    def start(self, pattern: Pattern) -> Factor:
        """Return the blocks of the identity."""
        return Factor(identity_values(pattern), unit_blocks(pattern, self.block_size), jnp.asarray(0))

    def factor(self, pattern: Pattern, values: Float[Array, " entries"], previous: Factor) -> Factor:
        """Invert the diagonal blocks of the sheet's part of the matrix.

        If a block is not positive definite, the matrix counts as indefinite."""
        lower, sound = block_factors(pattern, pattern.separate(values), self.block_size)
        return Factor(values, _inverses(lower), jnp.where(sound, -1, 1))

    def solve(
        self,
        pattern: Pattern,
        factor: Factor,
        values: Float[Array, " entries"] | None,
        rhs: Float[Array, " unknowns"],
        rtol: Scalar | float,
    ) -> LinearSolution:
        """Solve by conjugate gradients; a direction of negative curvature sets `indefinite`."""
        values = factor.values if values is None else values
        rows = pattern.expand(values)
        return conjugate_gradients(
            lambda d: pattern.expanded_product(rows, d) + pattern.contact_product(values, d),
            lambda r: apply_blocks(factor.workspace, r),
            factor,
            rhs,
            rtol,
            self.max_iterations,
        )


def load_lapack() -> None:
    """Load LAPACK, which JAX does when it lowers a function of it.

    A stored program is not lowered, and ends the process if it calls LAPACK first."""
    jax.jit(jax.lax.linalg.cholesky).lower(jnp.eye(1))


def unit_blocks(pattern: Pattern, size: int, dtype: Any = float) -> Float[Array, "blocks size size"]:
    """Return the diagonal blocks (b, size, size) of the identity."""
    count = -(-pattern.diagonal.shape[0] // size)
    return jnp.broadcast_to(jnp.eye(size, dtype=dtype), (count, size, size))


def block_factors(
    pattern: Pattern, values: Float[Array, " entries"], size: int
) -> tuple[Float[Array, "blocks size size"], Flag]:
    """Compute Cholesky factors (b, size, size) of the dense diagonal blocks of a sheet's `values` (nnz,).

    Returns the factors, and whether all blocks are positive definite. The identity fills the last block. If
    a block is not definite, all factors are the identity.
    """
    total = pattern.diagonal.shape[0]
    count = -(-total // size)
    row, col = pattern.rows, pattern.indices
    block = row // size
    inside = block == col // size
    # Entries outside the blocks get an index out of bounds, and are dropped.
    flat = jnp.where(inside, (block * size + row % size) * size + col % size, count * size * size)
    upper = jnp.zeros(count * size * size, values.dtype).at[flat].set(values, mode="drop")
    upper = upper.reshape(count, size, size)
    tail = jnp.arange(count * size).reshape(count, size) >= total
    dense = upper + jnp.swapaxes(jnp.triu(upper, 1), 1, 2) + jax.vmap(jnp.diag)(tail.astype(values.dtype))
    lower = jnp.linalg.cholesky(dense)
    sound = jnp.all(jnp.isfinite(lower))
    return jnp.where(sound, lower, jnp.eye(size)), sound


def _inverses(lower: Float[Array, "blocks size size"]) -> Float[Array, "blocks size size"]:
    identity = jnp.eye(lower.shape[-1])
    return jax.vmap(lambda c: jax.scipy.linalg.cho_solve((c, True), identity))(lower)


def apply_blocks(
    blocks: Float[Array, "blocks size size"], r: Float[Array, " unknowns"]
) -> Float[Array, " unknowns"]:
    """Multiply a block-diagonal matrix (b, m, m) by a vector, which is padded to fill the last block."""
    count, size, _ = blocks.shape
    return jnp.einsum("bij,bj->bi", blocks, pad_blocks(r, count, size)).reshape(-1)[: r.shape[0]]


def pad_blocks(r: Float[Array, " unknowns"], count: int, size: int) -> Float[Array, "blocks size"]:
    """Reshape a vector to rows (count, size), padded with zeros."""
    return jnp.pad(r, (0, count * size - r.shape[0])).reshape(count, size)
