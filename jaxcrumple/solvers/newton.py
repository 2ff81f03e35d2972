"""Newton's method on the condensed system (51)."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxcrumple.model.scene import Scene
from jaxcrumple.solvers.linear import AbstractLinearSolver, Factor
from jaxcrumple.system import ImplicitStep, linearize, residual

# An iteration that grows by more than this factor has left the basin of the root.
DIVERGENCE = 2.0
# A kept tangent that shrinks the update by less than this is renewed.
SLOW = 0.3
# Forcing term: relative residual to which each linear system is solved. A direct solver meets it with
# one back substitution; what an iterative one leaves is found by the next iteration.
FORCING = 1e-3


class NewtonSolution(NamedTuple):
    """Outcome of a Newton iteration.

    `x` (n, 3); `factor` the last tangent's; `iterations`, `linear` iterations and `factors` made;
    `converged`; `indefinite`: a tangent had a negative eigenvalue, so the equilibrium is unstable.
    """

    x: Array
    factor: Factor
    iterations: Array
    linear: Array
    factors: Array
    converged: Array
    indefinite: Array


class _Carry(NamedTuple):
    x: Array
    values: Array
    factor: Factor
    iterations: Array
    linear: Array
    factors: Array
    update: Array
    renew: Array
    converged: Array
    failed: Array
    indefinite: Array


def newton(
    scene: Scene,
    step: ImplicitStep,
    guess: Array,
    linear: AbstractLinearSolver,
    factor: Factor,
    tolerance: Array,
    max_iterations: int,
) -> NewtonSolution:
    """Find x with zero residual, with the exact tangent.

    A solver whose factor solves exactly keeps tangent and factor within the step for as long as they
    contract; for the others every iteration has its own tangent and the first one's preconditioner.
    Stops when the remaining error, estimated from the contraction of the updates, is below
    `tolerance` (m, maximum norm), or when the updates grow, or the tangent is indefinite, or after
    `max_iterations`.
    """

    def renewed(x: Array, carry: _Carry) -> tuple[Array, Array, Factor]:
        value, values = linearize(scene, step, x)
        return value, values, linear.factor(scene.pattern, values, carry.factor)

    def kept(x: Array, carry: _Carry) -> tuple[Array, Array, Factor]:
        if linear.exact:
            return residual(scene, step, x)[0], carry.values, carry.factor
        return *linearize(scene, step, x), carry.factor

    def body(carry: _Carry) -> _Carry:
        value, values, factor = jax.lax.cond(carry.renew, renewed, kept, carry.x, carry)
        solution = linear.solve(scene.pattern, factor, values, -value.reshape(-1), FORCING)
        x = carry.x + solution.x.reshape(carry.x.shape)
        update = jnp.max(jnp.abs(solution.x))
        contraction = jnp.where(carry.iterations == 0, 1.0, update / carry.update)
        remaining = jnp.where(contraction < 1, contraction / (1 - contraction) * update, jnp.inf)
        # Without a contraction rate yet, quadratic convergence is trusted only for tiny updates.
        converged = (remaining < tolerance) | (update < 0.01 * tolerance)
        failed = ~jnp.isfinite(update) | (contraction > DIVERGENCE) | solution.indefinite
        return _Carry(
            x,
            values,
            factor,
            carry.iterations + 1,
            carry.linear + solution.iterations,
            carry.factors + carry.renew,
            update,
            (contraction > SLOW) & (carry.iterations > 0),
            converged & ~failed,
            failed,
            solution.indefinite,
        )

    def unfinished(carry: _Carry) -> Array:
        return ~carry.converged & ~carry.failed & (carry.iterations < max_iterations)

    zero, no = jnp.asarray(0), jnp.asarray(False)
    init = _Carry(guess, factor.values, factor, zero, zero, zero, jnp.asarray(jnp.inf), ~no, no, no, no)
    end = jax.lax.while_loop(unfinished, body, init)
    return NewtonSolution(
        end.x, end.factor, end.iterations, end.linear, end.factors, end.converged, end.indefinite
    )
