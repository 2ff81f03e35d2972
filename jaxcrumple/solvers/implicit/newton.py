"""Newton's method on the condensed system (51)."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxcrumple._jax.arrays import Count, Flag, NodeVectors, Scalar
from jaxcrumple._jax.batched_cond import where_needed
from jaxcrumple._jax.tree import select
from jaxcrumple.history import NEVER, ImplicitStep, Linearization
from jaxcrumple.scene import Scene
from jaxcrumple.solvers.linear.base import AbstractLinearSolver, Factor
from jaxcrumple.system import linearize, residual

# An iteration diverges if its update grows by more than this factor.
DIVERGENCE = 2.0
# Refactorise if PATIENCE more iterations with the lagged tangent would not converge; a factorisation costs
# about that many.
PATIENCE = 4
# Steps with inertia use a lagged tangent for MOST_STEPS steps at most, and while the ratio of the beta h of
# both steps lies between RATIO and 1/RATIO.
MOST_STEPS, RATIO = 20, 0.6
# Forcing term: relative residual of each linear system. A direct solver meets it with one back substitution;
# the next Newton iteration corrects the residual of an iterative solver.
FORCING = 1e-3


class NewtonSolution(NamedTuple):
    """Hold the outcome of a Newton iteration.

    `x` (n, 3); `factor`: factor of the last tangent; `kept`: where that tangent was computed; `iterations`;
    `linear`: iterations of the linear solver; `factors`: number of factorisations; `converged`; `indefinite`:
    whether a tangent had a negative eigenvalue, so that the equilibrium is unstable; `restored`: whether the
    call only recomputed a missing factor.
    """

    x: NodeVectors
    factor: Factor
    kept: Linearization | None
    iterations: Count
    linear: Count
    factors: Count
    converged: Flag
    indefinite: Flag
    restored: Flag


class _Carry(NamedTuple):
    x: NodeVectors
    factor: Factor
    kept: Linearization
    iterations: Count
    linear: Count
    factors: Count
    update: Scalar
    renew: Flag
    converged: Flag
    failed: Flag
    indefinite: Flag


def newton(
    scene: Scene,
    step: ImplicitStep,
    guess: NodeVectors,
    linear: AbstractLinearSolver,
    factor: Factor,
    tolerance: Scalar,
    max_iterations: int,
    kept: Linearization | None,
    held: Flag,
) -> NewtonSolution:
    """Find x with zero residual by Newton's method.

    With an exact solver the tangent and its factor are lagged as long as the updates contract, also from one
    step with inertia to the next. `kept` states where the tangent of `factor` was computed, and `held`
    whether `factor` is valid. If it is not, the call only recomputes it. With other solvers every iteration
    computes its own tangent, and uses the preconditioner of the first one.

    The iteration stops when the remaining error, estimated from the contraction of the updates, is below
    `tolerance` (m, maximum norm). It also stops when the updates grow, when the tangent is indefinite, or
    after `max_iterations`.
    """
    old = Linearization(step, guess, jnp.asarray(NEVER, int)) if kept is None else kept
    restores = must_restore(old, held)
    usable = _usable(step, old) if linear.exact and kept is not None else jnp.asarray(False)

    def renewed(carry: _Carry) -> Factor:
        here = select(restores, (old.step, old.x), (step, carry.x))
        return linear.factor(scene.sparsity, linearize(scene, *here)[1], carry.factor)

    def tangent(carry: _Carry) -> tuple[Float[Array, " entries"] | None, Factor]:
        if linear.exact:
            factor = jax.lax.cond(carry.renew, renewed, lambda carry: carry.factor, carry)
            return None, factor
        _, values = linearize(scene, step, carry.x)
        factor = where_needed(carry.renew, linear.factor, carry.factor, scene.sparsity, values, carry.factor)
        return values, factor

    def body(carry: _Carry) -> _Carry:
        value, _ = residual(scene, step, carry.x)
        values, factor = tangent(carry)
        taken = Linearization(step, carry.x, jnp.zeros_like(old.age))
        kept = select(carry.renew, taken, carry.kept)
        solution = linear.solve(scene.sparsity, factor, values, -value.reshape(-1), FORCING)
        change = _relaxation(step, kept) * solution.x.reshape(carry.x.shape)
        update = jnp.max(jnp.abs(change))
        first = jnp.isinf(carry.update)
        contraction = jnp.where(first, 1.0, update / carry.update)
        remaining = jnp.where(contraction < 1, contraction / (1 - contraction) * update, jnp.inf)
        # The first update has no contraction rate; quadratic convergence is assumed for tiny updates only.
        converged = (remaining < tolerance) | (update < 0.01 * tolerance)
        lost = ~jnp.isfinite(update) | (contraction > DIVERGENCE) | solution.indefinite
        # Failure with the tangent of an earlier step proves nothing: restart with the tangent of this step.
        again = lost & (kept.age > 0)
        return _Carry(
            jnp.where(again, guess, carry.x + change),
            factor,
            kept,
            carry.iterations + 1,
            carry.linear + solution.iterations,
            carry.factors + carry.renew,
            jnp.where(again, jnp.inf, update),
            again | (~first & (remaining * contraction**PATIENCE > tolerance)),
            converged & ~lost,
            lost & ~again,
            solution.indefinite & ~again,
        )

    def unfinished(carry: _Carry) -> Flag:
        over = carry.converged | carry.failed | (restores & (carry.iterations > 0))
        return ~over & (carry.iterations < max_iterations)

    zero, no = jnp.asarray(0), jnp.asarray(False)
    first = eqx.tree_at(lambda k: k.age, old, jnp.where(usable, old.age + 1, NEVER))
    start = _Carry(
        guess, factor, first, zero, zero, zero, jnp.asarray(jnp.inf), ~usable | restores, no, no, no
    )
    end = jax.lax.while_loop(unfinished, body, start)
    age = jnp.where(end.converged, end.kept.age, NEVER)
    last = None
    if kept is not None:
        last = select(restores, kept, eqx.tree_at(lambda k: k.age, end.kept, age))
    return NewtonSolution(
        end.x, end.factor, last, end.iterations, end.linear, end.factors, end.converged & ~restores,
        end.indefinite, restores,
    )  # fmt: skip


def must_restore(kept: Linearization, held: Flag) -> Flag:
    """Return whether the lagged tangent is usable but its factor is missing (not `held`)."""
    return (kept.age < NEVER) & ~held


def _usable(step: ImplicitStep, kept: Linearization) -> Flag:
    """Return whether the tangent of an earlier step may serve this step."""
    ratio = step.beta_h / kept.step.beta_h
    alike = (ratio > RATIO) & (ratio * RATIO < 1.0)
    return alike & (kept.age < MOST_STEPS) & (step.inertia * kept.step.inertia > 0)


def _relaxation(step: ImplicitStep, kept: Linearization) -> Scalar:
    """Return the relaxation factor of an update with the tangent of another step.

    The two steps weight inertia differently. The factor minimises the larger of the errors left in modes
    dominated by inertia and in modes dominated by stiffness."""
    weight = (kept.step.beta_h / step.beta_h) ** 2
    return 2.0 / (1.0 + weight)
