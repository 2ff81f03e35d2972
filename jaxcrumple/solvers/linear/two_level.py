"""Two-level conjugate gradients in pure JAX: an additive preconditioner of dense blocks and a coarse space.

Blocks do not reduce errors in the long-wave bending modes of a sheet. A coarse space of splines on the
reference sheet does, also when the sheet is crumpled (additive Schwarz: Toselli & Widlund, Domain
Decomposition Methods, 2005). The coarse matrix is computed and factored in float64, because it contains
stretching and bending, which differ by many orders of magnitude. Both levels are applied in float32 as
$L^{-T} L^{-1}$, which is positive definite for any rounding error. A rounded inverse is not, and would make A
appear indefinite.
"""

from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxcrumple._jax.arrays import Flag, Scalar
from jaxcrumple._jax.device import on_accelerator
from jaxcrumple.assembly.coarse_space import SUPPORT, WINDOW, CoarseSpace
from jaxcrumple.assembly.sparsity import FULL, Pattern
from jaxcrumple.solvers.linear.base import AbstractLinearSolver, Factor, LinearSolution, identity_values
from jaxcrumple.solvers.linear.block_jacobi import block_factors, load_lapack, pad_blocks, unit_blocks
from jaxcrumple.solvers.linear.cg import conjugate_gradients

# Cells of the coarse grid whose rows a CPU multiplies together, so that their arrays stay in its cache.
BATCH = 8
# Shift of the scaled coarse matrix, because functions that hardly overlap the sheet are nearly dependent.
SHIFT = 1e-10


class _Levels(NamedTuple):
    """Hold inverse Cholesky factors of the blocks (b, m, m) and of the coarse matrix, in float32."""

    blocks: Float[Array, "blocks size size"]
    coarse: Float[Array, "coarse coarse"]


class TwoLevel(AbstractLinearSolver):
    """Solve by conjugate gradients with a two-level preconditioner.

    **Arguments:**

    - `block_size`: unknowns per dense block of the Hilbert ordering.
    - `max_iterations`: largest number of iterations; the solver then returns the last iterate.
    """

    exact: ClassVar[bool] = False
    block_size: int = eqx.field(static=True, default=48)
    max_iterations: int = 5000

    def load_library(self) -> None:
        """Load LAPACK."""
        load_lapack()

    def start(self, pattern: Pattern) -> Factor:
        """Return both levels for the identity matrix."""
        blocks = unit_blocks(pattern, self.block_size, jnp.float32)
        coarse = jnp.eye(3 * pattern.coarse.size, dtype=jnp.float32)
        return Factor(identity_values(pattern), _Levels(blocks, coarse), jnp.asarray(0))

    def factor(self, pattern: Pattern, values: Float[Array, " entries"], previous: Factor) -> Factor:
        """Factor the blocks and the coarse matrix of the sheet's part of A.

        If one is not positive definite, A counts as indefinite."""
        own = pattern.separate(values)
        lower, sound = block_factors(pattern, own, self.block_size)
        blocks = jax.vmap(_inverse_lower)(lower)
        # This data dependence runs the two batches of LAPACK calls one after the other. Under `vmap`, two
        # simultaneous batches would hang a machine of two threads, see `solvers/explicit/stability.py`.
        sound = sound & jnp.all(jnp.isfinite(blocks))
        matrix = coarse_matrix(pattern, own)
        coarse, definite = _coarse_factor(jnp.where(sound, matrix, jnp.eye(matrix.shape[0])))
        levels = _Levels(blocks.astype(jnp.float32), coarse.astype(jnp.float32))
        return Factor(values, levels, jnp.where(sound & definite, -1, 1))

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
        levels, space = factor.workspace, pattern.coarse
        weights = _cell_weights(space).astype(jnp.float32)

        def precondition(r: Float[Array, " unknowns"]) -> Float[Array, " unknowns"]:
            single = r.astype(jnp.float32)
            smooth = _solve_coarse(levels.coarse, _restrict(space, weights, single))
            both = _solve_blocks(levels.blocks, single) + _prolong(space, weights, smooth)
            return both.astype(r.dtype)

        return conjugate_gradients(
            lambda d: pattern.expanded_product(rows, d) + pattern.contact_product(values, d),
            precondition,
            factor,
            rhs,
            rtol,
            self.max_iterations,
        )


def _inverse_lower(lower: Float[Array, "rows rows"]) -> Float[Array, "rows rows"]:
    return jax.scipy.linalg.solve_triangular(lower, jnp.eye(lower.shape[0]), lower=True)


def _solve_coarse(
    inverse: Float[Array, "coarse coarse"], y: Float[Array, " coarse"]
) -> Float[Array, " coarse"]:
    """Compute $L^{-T} L^{-1}$ y with the inverse factor of the coarse matrix."""
    half = jnp.matmul(inverse, y, precision=FULL)
    if not on_accelerator():
        return jnp.matmul(half, inverse, precision=FULL)
    # XLA makes two kernels of that product on a GPU, and one of three parts whose sum follows.
    parts = inverse.reshape(3, -1, half.shape[0]), half.reshape(3, -1)
    first, second, third = jnp.einsum("aij,ai->aj", *parts, precision=FULL)
    return first + second + third


def _solve_blocks(
    inverse: Float[Array, "blocks size size"], r: Float[Array, " unknowns"]
) -> Float[Array, " unknowns"]:
    """Compute $L^{-T} L^{-1}$ r with the inverse factors (b, m, m) of the diagonal blocks."""
    count, size, _ = inverse.shape
    half = jnp.einsum("bij,bj->bi", inverse, pad_blocks(r, count, size), precision=FULL)
    return jnp.einsum("bji,bj->bi", inverse, half, precision=FULL).reshape(-1)[: r.shape[0]]


def _cell_weights(space: CoarseSpace) -> Float[Array, "cells functions members"]:
    """Return the weights (c, 16, k) of the members of each cell, padded with 0."""
    weights = space.weights
    product = (weights[:, 0, :, None] * weights[:, 1, None, :]).reshape(-1, SUPPORT**2)
    return jnp.swapaxes(product.at[space.members].get(mode="fill", fill_value=0.0), 1, 2)


def _restrict(
    space: CoarseSpace, weights: Float[Array, "cells functions members"], r: Float[Array, " unknowns"]
) -> Float[Array, " coarse"]:
    """Compute the coarse components (3 size,) of a fine vector (3n,): Z^T r."""
    fine = r.reshape(-1, 3).T.at[:, space.members].get(mode="fill", fill_value=0.0)
    # A sum of products along the last axis, which XLA on CPU runs three times faster than the einsum.
    local = jnp.sum(weights[:, :, None] * jnp.swapaxes(fine, 0, 1)[:, None], axis=-1)
    # A gather of what the cells contribute: a scatter is two kernels on a GPU.
    parts = local.reshape(-1, 3).at[space.owners].get(mode="fill", fill_value=0.0)
    return jnp.sum(parts, axis=0).reshape(-1)


def _prolong(
    space: CoarseSpace, weights: Float[Array, "cells functions members"], y: Float[Array, " coarse"]
) -> Float[Array, " unknowns"]:
    """Compute the fine vector (3n,) of coarse components (3 size,): Z y."""
    local = y.reshape(-1, 3).at[space.functions].get(mode="fill", fill_value=0.0)
    # As in the restriction, faster on CPU than the einsum.
    fine = jnp.sum(weights[..., None] * local[:, :, None], axis=1)
    return fine.reshape(-1, 3)[space.place].reshape(-1)


def coarse_matrix(pattern: Pattern, values: Float[Array, " entries"]) -> Float[Array, "coarse coarse"]:
    """Compute the Galerkin matrix Z^T A Z (3 size, 3 size) of a sheet's `values` (nnz,), cell by cell.

    A row of A times Z involves a window of functions only, whose weights are products of two directions. A
    cell therefore costs a few small dense products for any mesh.
    """
    space = pattern.coarse
    rows = pattern.expand(values).reshape(*pattern.neighbors.shape[:1], 3, -1, 3)

    def cell(
        data: tuple[Int[Array, " members"], Float[Array, "functions members"]],
    ) -> Float[Array, "functions 3 3 window"]:
        members, weights = data
        others = pattern.neighbors.at[members].get(mode="fill", fill_value=0)
        blocks = rows.at[members].get(mode="fill", fill_value=0.0)
        offset = space.cell[others] - space.cell[members][:, None]
        along = [_window_weights(space.weights[others][..., i, :], offset[..., i]) for i in range(2)]
        product = along[0][..., :, None] * along[1][..., None, :]
        image = jnp.einsum("nakb,nkw->nabw", blocks, product.reshape(*others.shape, WINDOW**2))
        return jnp.einsum("sn,nabw->sabw", weights, image)

    cells = space.members, _cell_weights(space)
    local = jax.vmap(cell)(cells) if on_accelerator() else jax.lax.map(cell, cells, batch_size=BATCH)
    size = space.size
    matrix = jnp.zeros((size, 3, size, 3), values.dtype)
    index = (space.functions[:, :, None], slice(None), space.window[:, None, :], slice(None))
    # Advanced indices around slices come first: (c, 16, 36, 3, 3).
    matrix = matrix.at[index].add(jnp.moveaxis(local, -1, 2), mode="drop")
    return matrix.reshape(3 * size, 3 * size)


def _window_weights(
    weights: Float[Array, "*axes support"], offset: Int[Array, " *axes"]
) -> Float[Array, "*axes window"]:
    """Return weights (..., 6) of functions -1 ... 4 of a cell at nodes `offset` (-1, 0, 1) cells away."""
    index = jnp.arange(WINDOW) - 1 - offset[..., None]
    inside = (index >= 0) & (index < SUPPORT)
    return jnp.where(inside, jnp.take_along_axis(weights, jnp.clip(index, 0, SUPPORT - 1), axis=-1), 0.0)


def _coarse_factor(matrix: Float[Array, "coarse coarse"]) -> tuple[Float[Array, "coarse coarse"], Flag]:
    """Return the inverse Cholesky factor of the coarse matrix, and whether it is positive definite."""
    size = matrix.shape[0]
    diagonal = jnp.diag(matrix)
    # A function without nodes in its support has an empty row.
    scale = jnp.where(diagonal > 0, 1.0 / jnp.sqrt(jnp.where(diagonal > 0, diagonal, 1.0)), 0.0)
    scaled = scale[:, None] * matrix * scale[None] + jnp.diag(jnp.where(scale > 0, SHIFT, 1.0))
    lower = jnp.linalg.cholesky(0.5 * (scaled + scaled.T))
    definite = jnp.all(jnp.isfinite(lower)) & jnp.all(diagonal >= 0)
    return _inverse_lower(jnp.where(definite, lower, jnp.eye(size))) * scale[None], definite
