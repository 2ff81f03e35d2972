"""`linear_solve`: any of the linear solvers as a differentiable function."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from jaxcrumple._jax.door import door
from jaxcrumple._jax.tree import as_float
from jaxcrumple.assembly.sparsity import Pattern
from jaxcrumple.solvers.linear.base import AbstractLinearSolver, Factor
from jaxcrumple.solvers.linear.registry import choose_linear_solver

# Factor by which a residual may exceed what was asked for and rounding together.
SLACK = 10.0


@door
def linear_solve(
    solver: str | AbstractLinearSolver,
    pattern: Pattern,
    values: ArrayLike,
    rhs: ArrayLike,
    rtol: float = 1e-10,
) -> Array:
    """Solution (3n,) of A x = `rhs`, differentiable with respect to `values` (size,) and `rhs`.

    The derivatives, forward and reverse, follow from the implicit function theorem, dA x + A dx = db,
    and are solved with the same factor to the same `rtol`. A sheet about to buckle has an indefinite matrix:
    the direct solver solves that too, the others only definite ones. Where the residual stays above `rtol`
    and above what rounding explains, the solution is NaN.

    **Arguments:** `solver`: its name ("auto", "direct", "two-level", "block-cg") or itself; `pattern`: that
    of a scene; `values` (size,) of the upper triangle in N/m, as `elastic_tangent` returns them; `rhs` (3n,)
    in N.

    **Raises:** ValueError for an unknown solver, or arrays that do not fit the pattern.
    """
    solver = choose_linear_solver(solver)
    if not isinstance(pattern, Pattern):
        raise ValueError(f"pattern has type {type(pattern).__name__}; it must be scene.pattern.")
    values, rhs = as_float(values), as_float(rhs)
    size = pattern.diagonal.shape
    if values.shape != (pattern.size,) or rhs.shape != size:
        raise ValueError(
            f"values {values.shape} and rhs {rhs.shape} do not fit the pattern: ({pattern.size},) and {size}."
        )
    factor = solver.factor(pattern, jax.lax.stop_gradient(values), solver.start(pattern))

    def solve(b: Array) -> Array:
        return solver.solve_factored(pattern, factor, b, rtol)

    return _solved(solve, pattern, values, rhs, rtol)


def solve_once(
    solver: AbstractLinearSolver, pattern: Pattern, start: Factor, values: Array, rhs: Array, rtol: float
) -> Array:
    """The same where no other system has these `values`; `start` may serve many such solutions."""

    def solve(b: Array) -> Array:
        return solver.solve_once(pattern, start, jax.lax.stop_gradient(values), b, rtol)

    return _solved(solve, pattern, values, rhs, rtol)


def _solved(
    solve: Callable[[Array], Array], pattern: Pattern, values: Array, rhs: Array, rtol: float
) -> Array:
    """What `solve` finds, differentiable; NaN where the residual is not what was asked for."""

    def checked(_, b: Array) -> Array:
        x, own = solve(b), jax.lax.stop_gradient(values)
        left = jnp.linalg.norm(b - pattern.product(own, x))
        rounding = jnp.finfo(b.dtype).eps * jnp.max(jnp.abs(own)) * jnp.linalg.norm(x)
        return jnp.where(left <= SLACK * (rtol * jnp.linalg.norm(b) + rounding), x, jnp.nan)

    return jax.lax.custom_linear_solve(lambda x: pattern.product(values, x), rhs, checked, symmetric=True)
