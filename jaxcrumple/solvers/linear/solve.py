"""`linear_solve`: each linear solver as a differentiable function."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Real

from jaxcrumple._jax.door import door
from jaxcrumple._jax.tree import as_float
from jaxcrumple.assembly.sparsity import Pattern
from jaxcrumple.solvers.linear.base import AbstractLinearSolver, Factor
from jaxcrumple.solvers.linear.registry import choose_linear_solver

# A residual may exceed the sum of its tolerance and the rounding error by this factor.
SLACK = 10.0


@door
def linear_solve(
    solver: str | AbstractLinearSolver,
    pattern: Pattern,
    values: Real[ArrayLike, " entries"],
    rhs: Real[ArrayLike, " unknowns"],
    rtol: float = 1e-10,
) -> Float[Array, " unknowns"]:
    """Solve A x = `rhs` for x (3n,), differentiable with respect to `values` (size,) and `rhs`.

    The derivatives, forward and reverse, follow from the implicit function theorem, dA x + A dx = db. They
    use the same factor and the same `rtol`. A sheet about to buckle has an indefinite matrix. The direct
    solver solves it too, the other solvers solve definite matrices only. The solution is NaN if the residual
    exceeds both `rtol` and the rounding error.

    **Arguments:** `solver`: a solver or its name ("auto", "direct", "two-level", "block-cg"); `pattern`: the
    pattern of a scene; `values` (size,): upper triangle of A in N/m, as `elastic_tangent` returns it; `rhs`
    (3n,) in N; `rtol`: relative residual.

    **Raises:** ValueError for an unknown solver, or arrays that do not fit the pattern.
    """
    solver = choose_linear_solver(solver)
    if not isinstance(pattern, Pattern):
        raise ValueError(f"pattern has type {type(pattern).__name__}; it must be scene.sparsity.")
    values, rhs = as_float(values), as_float(rhs)
    size = pattern.diagonal.shape
    if values.shape != (pattern.size,) or rhs.shape != size:
        raise ValueError(
            f"values {values.shape} and rhs {rhs.shape} do not fit the pattern: ({pattern.size},) and {size}."
        )
    factor = solver.factor(pattern, jax.lax.stop_gradient(values), solver.start(pattern))

    def solve(b: Float[Array, " unknowns"]) -> Float[Array, " unknowns"]:
        return solver.solve_factored(pattern, factor, b, rtol)

    return _solved(solve, pattern, values, rhs, rtol)


def solve_once(
    solver: AbstractLinearSolver,
    pattern: Pattern,
    start: Factor,
    values: Float[Array, " entries"],
    rhs: Float[Array, " unknowns"],
    rtol: float,
) -> Float[Array, " unknowns"]:
    """Solve like `linear_solve`, with a factor for one system only; `start` may serve many calls."""

    def solve(b: Float[Array, " unknowns"]) -> Float[Array, " unknowns"]:
        return solver.solve_once(pattern, start, jax.lax.stop_gradient(values), b, rtol)

    return _solved(solve, pattern, values, rhs, rtol)


def _solved(
    solve: Callable[[Float[Array, " unknowns"]], Float[Array, " unknowns"]],
    pattern: Pattern,
    values: Float[Array, " entries"],
    rhs: Float[Array, " unknowns"],
    rtol: float,
) -> Float[Array, " unknowns"]:
    """Make the solution of `solve` differentiable; it is NaN if the residual exceeds the tolerance."""

    def checked(_: Any, b: Float[Array, " unknowns"]) -> Float[Array, " unknowns"]:
        x, own = solve(b), jax.lax.stop_gradient(values)
        left = jnp.linalg.norm(b - pattern.product(own, x))
        rounding = jnp.finfo(b.dtype).eps * jnp.max(jnp.abs(own)) * jnp.linalg.norm(x)
        return jnp.where(left <= SLACK * (rtol * jnp.linalg.norm(b) + rounding), x, jnp.nan)

    return jax.lax.custom_linear_solve(lambda x: pattern.product(values, x), rhs, checked, symmetric=True)
