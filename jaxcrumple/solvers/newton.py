"""Newton's method on the condensed system (51)."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxcrumple.model.scene import Scene
from jaxcrumple.solvers.linear import AbstractLinearSolver, Factor
from jaxcrumple.system import ImplicitStep, linearize

# An iteration that grows by more than this factor has left the basin of the root.
DIVERGENCE = 2.0


class NewtonSolution(NamedTuple):
    """Outcome of a Newton iteration.

    `x` (n, 3); `factor` the last tangent's; `iterations`, `linear` iterations; `converged`;
    `indefinite`: the last tangent has a negative eigenvalue, so the equilibrium is unstable.
    """

    x: Array
    factor: Factor
    iterations: Array
    linear: Array
    converged: Array
    indefinite: Array


class _Carry(NamedTuple):
    x: Array
    factor: Factor
    iterations: Array
    linear: Array
    update: Array
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

    Stops when the remaining error, estimated from the contraction of the updates, is below
    `tolerance` (m, maximum norm), or when the updates grow, or after `max_iterations`.
    """

    def body(carry: _Carry) -> _Carry:
        residual, values = linearize(scene, step, carry.x)
        factor = linear.factor(scene.pattern, values, carry.factor)
        solution = linear.solve(scene.pattern, factor, -residual.reshape(-1))
        x = carry.x + solution.x.reshape(carry.x.shape)
        update = jnp.max(jnp.abs(solution.x))
        first = carry.iterations == 0
        contraction = jnp.where(first, 1.0, update / carry.update)
        remaining = jnp.where(contraction < 1, contraction / (1 - contraction) * update, jnp.inf)
        # Without a contraction rate yet, quadratic convergence is trusted only for tiny updates.
        converged = (remaining < tolerance) | (update < 0.01 * tolerance)
        failed = ~jnp.isfinite(update) | (contraction > DIVERGENCE)
        return _Carry(
            x,
            factor,
            carry.iterations + 1,
            carry.linear + solution.iterations,
            update,
            converged & jnp.isfinite(update),
            failed,
            carry.indefinite | solution.indefinite,
        )

    def unfinished(carry: _Carry) -> Array:
        return ~carry.converged & ~carry.failed & (carry.iterations < max_iterations)

    zero, no = jnp.asarray(0), jnp.asarray(False)
    init = _Carry(guess, factor, zero, zero, jnp.asarray(jnp.inf), no, no, no)
    end = jax.lax.while_loop(unfinished, body, init)
    return NewtonSolution(end.x, end.factor, end.iterations, end.linear, end.converged, end.indefinite)
