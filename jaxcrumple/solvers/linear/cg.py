"""Preconditioned conjugate gradients, the Krylov loop of all linear solvers."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxcrumple._jax.arrays import Count, Flag, Scalar
from jaxcrumple.solvers.linear.base import Factor, LinearSolution


class _Carry(NamedTuple):
    x: Float[Array, " unknowns"]
    r: Float[Array, " unknowns"]
    d: Float[Array, " unknowns"]
    size: Scalar
    per_rz: Scalar
    positive: Flag
    going: Flag
    iterations: Count


def conjugate_gradients(
    product: Callable[[Float[Array, " unknowns"]], Float[Array, " unknowns"]],
    precondition: Callable[[Float[Array, " unknowns"]], Float[Array, " unknowns"]],
    factor: Factor,
    rhs: Float[Array, " unknowns"],
    rtol: Scalar | float,
    max_iterations: int,
) -> LinearSolution:
    """Solve A x = `rhs` (m,) until $\\|r\\|_2 \\le$ `rtol` $\\|b\\|_2$ (Saad, Iterative Methods, alg. 9.1).

    Each iteration applies `precondition` once, to the residual of unit length; it is not applied after the
    last iteration. An exact preconditioner therefore costs one application and one product. A right-hand side
    that is not finite gives NaN. The iteration stops at a direction without positive curvature, and reports
    an indefinite matrix. If `factor` has negative eigenvalues it does not start, and returns x = 0.
    """
    known = factor.negative > 0
    rhs = jnp.where(known, 0.0, rhs)
    start = jnp.linalg.norm(rhs)
    goal = rtol * start

    def body(carry: _Carry) -> _Carry:
        z = carry.size * precondition(carry.r * (1.0 / carry.size))
        rz = _dot(carry.r, z)
        d = z + (rz * carry.per_rz) * carry.d
        image = product(d)
        bend = _dot(d, image)
        positive = (bend > 0) & (rz > 0)
        step = jnp.where(positive, rz / bend, 0.0)
        r = carry.r - step * image
        size, iterations = jnp.sqrt(_dot(r, r)), carry.iterations + 1
        # The condition of the loop is part of its body, because each one is a kernel more on a GPU.
        going = positive & (size > goal) & (iterations < max_iterations)
        return _Carry(carry.x + step * d, r, d, size, 1.0 / rz, positive, going, iterations)

    zero, yes = jnp.zeros_like(rhs), jnp.asarray(True)
    going = (start > goal) & (max_iterations > 0)
    init = _Carry(zero, rhs, zero, start, jnp.zeros((), rhs.dtype), yes, going, jnp.asarray(0))
    with jax.named_scope("conjugate-gradients"):
        end = jax.lax.while_loop(lambda carry: carry.going, body, init)
    # The loop does not start with a right-hand side that is not finite: return NaN instead of zero.
    x = jnp.where(jnp.isfinite(goal), end.x, jnp.nan)
    return LinearSolution(x, end.iterations, ~end.positive | known)


def _dot(a: Float[Array, " unknowns"], b: Float[Array, " unknowns"]) -> Scalar:
    """Return the dot product, as the sum of three parts: for a GPU XLA makes one kernel of them, and two of a
    dot product in one part."""
    parts = jnp.sum((a * b).reshape(3, -1), axis=1)
    return parts[0] + parts[1] + parts[2]
