"""Newton's method on the condensed system (51), in pieces that can wait for contact lists.

Each piece iterates until the equations are solved, the method fails, or an iterate leaves the motions that
the contact lists cover. The caller then rebuilds the lists around the iterate and goes on.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxcrumple._jax.arrays import Count, Flag, HingeValues, NodeVectors, Scalar
from jaxcrumple._jax.batched_cond import once, where_needed
from jaxcrumple._jax.tree import select
from jaxcrumple.contact.coverage import covers
from jaxcrumple.history import NEVER, ImplicitStep, Linearization
from jaxcrumple.scene import Scene
from jaxcrumple.solvers.implicit.secants import Secants
from jaxcrumple.solvers.linear.base import AbstractLinearSolver, Factor, LinearSolution
from jaxcrumple.system import condensed, step_tangent

# An iteration with the tangent of an earlier step diverges if its update grows by more than this factor.
DIVERGENCE = 2.0
# Refactorise if PATIENCE more iterations with the lagged tangent would not converge. A tangent and its factor
# take about as long as that many (n = 1000 in contact: 24 ms for 2.5 ms).
PATIENCE = 8
# Steps with inertia use a lagged tangent for MOST_STEPS steps at most, and while the ratio of the beta h of
# both steps lies between RATIO and 1/RATIO.
MOST_STEPS, RATIO = 20, 0.6
# Forcing term: relative residual of each linear system. A direct solver meets it with one back substitution;
# the next Newton iteration corrects the residual of an iterative solver.
FORCING = 1e-3
# A change is taken back if the residual along it ends with the other sign and more than OVERSHOOT of its
# size: in part, if the tangent is the step's own. What remains is then the zero of a straight line, between
# SMALLEST and LARGEST of it, down to LEAST.
OVERSHOOT, SMALLEST, LARGEST, LEAST = 0.7, 0.1, 0.7, 1e-3
# Part of a change that is taken back if the residual at its end is not finite, or too far away to compute.
UNSOUND = 0.3
# Largest change of an iterate in contact ranges.
STRETCH = 0.5
# Inertia that an indefinite tangent receives, as a multiple of the step's own: SHIFT, then GROW times as much
# as long as it is indefinite, up to MOST; then DECAY times as much in each iteration, until it is NEGLIGIBLE.
SHIFT, GROW, DECAY, NEGLIGIBLE, MOST = 1.0, 4.0, 0.25, 0.1, 1e4


# New rest curvature (h,) and its derivative by the curvature, and values (size,) of a tangent.
_Plastic = list[HingeValues | None]
_Values = Float[Array, " entries"]


class NewtonIteration(NamedTuple):
    """Hold an iteration between two pieces.

    `x` (n, 3) in m: iterate; `kept`: where the tangent of the factor was computed; `renew`: whether the next
    iteration computes its own; `change` (n, 3) and `update` in m: direction of the last change and its size,
    infinite before the first; `slope` in J: residual along the direction before the change, 0 if it is not to
    be taken back; `part`: how much of it was taken; `shift`: inertia in the tangent as a multiple of the
    step's; `start` (n, 3) in m and `value` (n, 3) in N: iterate before the last change, and its residual;
    `secants`: corrections of the factor by the changes since; `partial`: whether the tangent lacks pairs
    without entries in the matrix; `iterations`; `linear`: iterations of the linear solver; `factors`: number
    of factorisations; `converged`, `failed`; `indefinite`: whether it failed for a tangent with a negative
    eigenvalue, so that the equilibrium is unstable; `restores`: whether it only recomputes a missing factor.
    """

    x: NodeVectors
    kept: Linearization
    renew: Flag
    change: NodeVectors
    update: Scalar
    slope: Scalar
    part: Scalar
    shift: Scalar
    start: NodeVectors
    value: NodeVectors
    secants: Secants
    partial: Flag
    iterations: Count
    linear: Count
    factors: Count
    converged: Flag
    failed: Flag
    indefinite: Flag
    restores: Flag

    def is_over(self, most: int) -> Flag:
        """Return whether it has ended, after `most` iterations at the latest."""
        over = self.converged | self.failed | (self.restores & (self.iterations > 0))
        return over | (self.iterations >= most)

    def failing(self, when: Flag) -> "NewtonIteration":
        """Return the iteration, failed if `when`."""
        return self._replace(failed=self.failed | when)


def begin(
    step: ImplicitStep,
    guess: NodeVectors,
    linear: AbstractLinearSolver,
    kept: Linearization | None,
    held: Flag,
) -> NewtonIteration:
    """Begin to solve the equations of `step` from `guess` (n, 3) in m.

    With an exact solver the tangent and its factor are lagged as long as the updates contract, also from one
    step with inertia to the next. `kept` states where the tangent of the factor was computed (None: in no
    earlier step), and `held` whether the factor is there. If it is not, the iteration only recomputes it.
    With other solvers every iteration computes its own tangent, and uses the preconditioner of the first one.
    """
    old = Linearization(step, guess, jnp.asarray(NEVER, int)) if kept is None else kept
    restores = must_restore(old, held)
    usable = _usable(step, old) if linear.exact and kept is not None else jnp.asarray(False)
    first = eqx.tree_at(lambda k: k.age, old, jnp.where(usable, old.age + 1, NEVER))
    zero, no, nought = jnp.asarray(0), jnp.asarray(False), jnp.zeros(())
    rest = jnp.zeros_like(guess)
    return NewtonIteration(
        guess, first, ~usable | restores, rest, jnp.asarray(jnp.inf), nought, jnp.ones(()), nought,
        guess, rest, Secants.none(len(guess)), no, zero, zero, zero, no, no, no, restores,
    )  # fmt: skip


def go_on(
    scene: Scene,
    step: ImplicitStep,
    guess: NodeVectors,
    iteration: NewtonIteration,
    linear: AbstractLinearSolver,
    factor: Factor,
    tolerance: Scalar,
    most: int,
) -> tuple[NewtonIteration, Factor]:
    """Iterate until the iteration is over, or until the iterate leaves the contact lists of the scene.

    The iteration converges when the remaining error, estimated from the contraction of the updates, is below
    `tolerance` (m, maximum norm). In a step with inertia an indefinite tangent receives more inertia. A
    change that leads too far is taken back, in part or, by the tangent of an earlier step, whole: the
    residual is the gradient of an incremental energy, which must not rise steeply after the change.

    **Arguments:** `guess` (n, 3): start of the iteration, which begins anew if the tangent of another step
    does not serve; `most`: number of iterations after which it fails.
    """
    widest = jnp.inf if scene.contact is None else STRETCH * scene.contact.range

    def values(now: NewtonIteration, here: ImplicitStep, x: NodeVectors, plastic: _Plastic) -> _Values:
        stiffer = eqx.tree_at(lambda s: s.beta_h, here, here.beta_h / jnp.sqrt(1.0 + now.shift))
        return step_tangent(scene, stiffer, x, *plastic)

    def tangent(
        now: NewtonIteration,
        factor: Factor,
        renew: Flag,
        here: ImplicitStep,
        x: NodeVectors,
        plastic: _Plastic,
    ) -> tuple[_Values | None, Factor, Flag]:
        if not linear.exact:
            own = values(now, here, x, plastic)
            return own, where_needed(renew, linear.factor, factor, scene.sparsity, own, factor), now.partial

        def renewed(kept: tuple[Factor, Flag]) -> tuple[Factor, Flag]:
            own = values(now, here, x, plastic)
            return linear.factor(scene.sparsity, own, kept[0]), ~scene.sparsity.placed

        return None, *once(renew, renewed, (factor, now.partial))

    def body(carry: tuple[NewtonIteration, Factor]) -> tuple[NewtonIteration, Factor]:
        now, factor = carry
        here, x = select(now.restores, (now.kept.step, now.kept.x), (step, now.x))
        value, *plastic = condensed(scene, here, x)
        sound = jnp.all(jnp.isfinite(value))
        slope = jnp.vdot(value, now.change)
        too_far = (now.slope < 0) & (~sound | (slope > -OVERSHOOT * now.slope)) & (now.part > LEAST)
        own, factor, partial = tangent(now, factor, now.renew & ~too_far, here, x, plastic)

        def forward() -> NewtonIteration:
            taken = Linearization(step, now.x, jnp.zeros_like(now.kept.age))
            kept = select(now.renew & ~now.restores, taken, now.kept)
            known = now.secants.including(now.x - now.start, value - now.value, jnp.isfinite(now.update))
            secants = select(now.renew, Secants.none(len(value)), known) if linear.exact else now.secants
            solution = _solved(scene, linear, factor, own, value, secants)
            after = _taken(now, guess, step, kept, value, solution, widest, tolerance)
            return after._replace(start=now.x, value=value, secants=secants, partial=partial)

        def back() -> NewtonIteration:
            return _taken_back(now, x, value, sound, slope)

        return jax.lax.cond(too_far, back, forward), factor

    def unfinished(carry: tuple[NewtonIteration, Factor]) -> Flag:
        now, _ = carry
        return ~now.is_over(most) & covered(scene, now)

    with jax.named_scope("newton"):
        return jax.lax.while_loop(unfinished, body, (iteration, factor))


def covered(scene: Scene, iteration: NewtonIteration) -> Flag:
    """Return whether the contact lists cover the iterate, or the place of a factor to restore."""
    if scene.contact is None:
        return jnp.asarray(True)
    return iteration.restores | covers(scene.own_lists, iteration.x)


def _solved(
    scene: Scene,
    linear: AbstractLinearSolver,
    factor: Factor,
    own: _Values | None,
    value: NodeVectors,
    secants: Secants,
) -> LinearSolution:
    """Solve for the change that cancels the residual `value` (n, 3) in N, by the factor and the `secants`, or
    by an iterative solver with its own tangent."""
    if not linear.exact:
        return linear.solve(scene.sparsity, factor, own, -value.reshape(-1), FORCING)
    x = secants.applied(
        lambda force: linear.solve(scene.sparsity, factor, None, force.reshape(-1), FORCING).x.reshape(-1, 3),
        -value,
    )
    return LinearSolution(x.reshape(-1), jnp.asarray(1), factor.negative > 0)


def _taken(
    now: NewtonIteration,
    guess: NodeVectors,
    step: ImplicitStep,
    kept: Linearization,
    value: NodeVectors,
    solution: LinearSolution,
    widest: Scalar | float,
    tolerance: Scalar,
) -> NewtonIteration:
    """Return the iteration after a change of the iterate by the `solution`, of at most `widest` in m.

    `value` (n, 3) in N: residual before it; `kept`: where the tangent of the solution was computed."""
    indefinite = solution.indefinite
    relaxed = jnp.where(now.shift > 0, 1.0, _relaxation(step, kept))
    change = relaxed * solution.x.reshape(now.x.shape)
    length = jnp.max(jnp.abs(change))
    cut = length > widest
    change = jnp.where(cut, widest / length, 1.0) * change
    update = jnp.minimum(length, widest)
    first = jnp.isinf(now.update)
    whole = ~cut & (now.part == 1.0)
    contraction = jnp.where(first | ~whole, 1.0, update / now.update)
    remaining = jnp.where(contraction < 1, contraction / (1 - contraction) * update, jnp.inf)
    # The first update has no contraction rate; quadratic convergence is assumed for tiny updates only.
    near = (remaining < tolerance) | (update < 0.01 * tolerance)
    bad = indefinite | ~jnp.isfinite(update)
    # Failure with the tangent of an earlier step proves nothing: restart with the tangent of this step.
    again = (kept.age > 0) & (bad | (contraction > DIVERGENCE))
    stiffens = indefinite & ~again & (step.inertia > 0) & (now.shift < MOST)
    shift = jnp.where(stiffens, jnp.maximum(GROW * now.shift, SHIFT), DECAY * now.shift)
    shift = jnp.where(again, now.shift, jnp.where(shift < NEGLIGIBLE, 0.0, shift))
    failed = bad & ~again & ~stiffens
    stays = again | stiffens
    slow = ~first & (remaining * contraction**PATIENCE > tolerance)
    return now._replace(
        x=jnp.where(again, guess, jnp.where(stiffens, now.x, now.x + change)),
        kept=kept,
        renew=stays | jnp.where(whole, slow, now.secants.full) | (now.shift > 0),
        change=change,
        update=jnp.where(stays, jnp.inf, update),
        slope=jnp.where(stays, 0.0, jnp.vdot(value, change)),
        part=jnp.ones_like(now.part),
        shift=shift,
        iterations=now.iterations + 1,
        linear=now.linear + solution.iterations,
        factors=now.factors + now.renew,
        converged=near & ~bad & ~again & (now.shift == 0),
        failed=failed,
        indefinite=failed & indefinite,
    )


def _taken_back(
    now: NewtonIteration, x: NodeVectors, value: NodeVectors, sound: Flag, slope: Scalar
) -> NewtonIteration:
    """Return the iteration with a smaller part of its last change, which led too far, to `x` (n, 3).

    Of a change by the tangent of an earlier step nothing remains. The step's own tangent serves on, corrected
    by what was found at `x`, until the places for corrections are full.

    **Arguments:** `value` (n, 3) in N: residual at `x`; `sound`: whether it is finite; `slope` in J: residual
    along the change there.
    """
    lagged = now.kept.age > 0
    secant = jnp.where(sound, now.slope / (now.slope - slope), UNSOUND)
    share = jnp.clip(secant, SMALLEST, LARGEST)
    part = share * now.part
    return now._replace(
        x=jnp.where(lagged, now.start, now.x - (now.part - part) * now.change),
        part=jnp.where(lagged, 1.0, part),
        update=jnp.where(lagged, jnp.inf, share * now.update),
        slope=jnp.where(lagged, 0.0, now.slope),
        secants=now.secants.including(x - now.start, value - now.value, sound & ~lagged),
        renew=lagged | ~sound | now.secants.full,
        iterations=now.iterations + 1,
    )


def must_restore(kept: Linearization, held: Flag) -> Flag:
    """Return whether the lagged tangent is usable but its factor is missing (not `held`)."""
    return (kept.age < NEVER) & ~held


def last_tangent(iteration: NewtonIteration) -> Linearization:
    """Return where the tangent of the factor was computed, for the next step."""
    # A matrix with entries for more pairs would give another factor, and a resumed run might have it.
    serves = iteration.converged & ~iteration.partial
    return eqx.tree_at(lambda k: k.age, iteration.kept, jnp.where(serves, iteration.kept.age, NEVER))


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
