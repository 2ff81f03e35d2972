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
    rz: Scalar
    positive: Flag
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

    Each iteration applies `precondition` once; it is not applied after the last iteration. An exact
    preconditioner therefore costs one application and one product. A right-hand side that is not finite gives
    NaN. The iteration stops at a direction without positive curvature, and reports an indefinite matrix. If
    `factor` has negative eigenvalues it does not start, and returns x = 0.
    """
    known = factor.negative > 0
    rhs = jnp.where(known, 0.0, rhs)
    goal = rtol * jnp.linalg.norm(rhs)

    def body(carry: _Carry) -> _Carry:
        z = precondition(carry.r)
        rz = carry.r @ z
        d = jnp.where(carry.iterations == 0, z, z + (rz / carry.rz) * carry.d)
        image = product(d)
        bend = d @ image
        positive = (bend > 0) & (rz > 0)
        step = jnp.where(positive, rz / bend, 0.0)
        return _Carry(carry.x + step * d, carry.r - step * image, d, rz, positive, carry.iterations + 1)

    def unfinished(carry: _Carry) -> Flag:
        far = jnp.linalg.norm(carry.r) > goal
        return carry.positive & far & (carry.iterations < max_iterations)

    zero = jnp.zeros_like(rhs)
    init = _Carry(zero, rhs, zero, jnp.ones((), rhs.dtype), jnp.asarray(True), jnp.asarray(0))
    end = jax.lax.while_loop(unfinished, body, init)
    # The loop does not start with a right-hand side that is not finite: return NaN instead of zero.
    x = jnp.where(jnp.isfinite(goal), end.x, jnp.nan)
    return LinearSolution(x, end.iterations, ~end.positive | known)
