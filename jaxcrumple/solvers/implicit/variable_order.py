"""Implicit stages with one solve a step: BDF of order 1 to 5, limited by stability in steps with inertia."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxcrumple._jax.arrays import Count, Flag, HingeValues, NodeVectors, Scalar
from jaxcrumple._jax.batched_cond import where_needed
from jaxcrumple._jax.tree import as_float, select
from jaxcrumple.assembly.sparsity import Pattern
from jaxcrumple.history import ImplicitStep
from jaxcrumple.scene import Scene
from jaxcrumple.solvers.implicit.base import (
    LOCAL_SHARE,
    AbstractImplicit,
    ImplicitAttempt,
    aligns,
    judge,
    resized,
)
from jaxcrumple.solvers.implicit.bdf import damped_order, error_constant, extrapolation, step_formula
from jaxcrumple.solvers.implicit.newton import FORCING, NewtonIteration, begin, go_on, last_tangent
from jaxcrumple.solvers.linear.base import AbstractLinearSolver, Factor
from jaxcrumple.state import CAUSES, IMPLICIT, State
from jaxcrumple.system import updated_rest_curvature

# The order changes only for a step longer by this factor.
ORDER_GAIN = 1.1
# Largest ratio of the length of a vector to its largest component.
DIAGONAL = 3.0**0.5
# Newton's iteration starts from an extrapolation, and its remaining error adds energy. Formulas with
# rho_infinity > 0 dissipate little or none of it, so that their Newton tolerance is smaller by this factor.
CONSERVING = 1e-3
# If drag lets the errors of more than REMEMBERED steps with inertia add up, each step gets a smaller share of
# the tolerance; the share stops falling at MOST_REMEMBERED steps. Local errors largely cancel, but those of
# Newton's method have one sign, so that their part of it falls too, with this power ONE_SIGN of it: bounces
# without drag need 0.0075 of the local error.
ONE_SIGN = 2.0 / 3.0
REMEMBERED, MOST_REMEMBERED = 500.0, 1e4


class VariableOrder(AbstractImplicit):
    """Implement steps whose error estimate is the difference of predictor and corrector.

    The step control chooses the order, up to `max_order`, with the longest predicted step. Steps with inertia
    use the two-step family of `two_step`. They use BDF 3 to 5 if the step is long enough for drag to make
    these stable (`damped_order`).

    - `rtol`: tolerance on the local error in the maximum norm: positions in units of $\\sqrt A$, p in units
      of 2.
    - `linear`: the linear solver.
    - `rho_infinity`: share of the amplitude of a mode of infinite frequency that a step with inertia leaves,
      from 0 (BDF2) to 1 (midpoint rule). Above 0 the Newton tolerance is smaller by the factor CONSERVING,
      because the error would add more energy than the formula dissipates.
    - `inertial_share`: share of `rtol` that the local error of a step with inertia may use. It decreases if
      drag is so weak that the errors of more than `REMEMBERED` steps add up.
    - `newton_share`: Newton tolerance as a share of the tolerated local error, if drag lets no errors add up.
    - `max_order`: largest order, 1 to 5.
    - `max_iterations`: Newton iterations before a step is rejected.
    - `inertia`: whether any stage has inertia; without it, no code for inertia is compiled.
    """

    rtol: Scalar
    linear: AbstractLinearSolver
    rho_infinity: Scalar = eqx.field(default=0.0, converter=as_float)
    inertial_share: Scalar = eqx.field(default=LOCAL_SHARE, converter=as_float)
    newton_share: Scalar = eqx.field(default=0.05, converter=as_float)
    inertia: bool = eqx.field(static=True, default=True)
    max_order: int = eqx.field(static=True, default=5)
    max_iterations: int = eqx.field(static=True, default=20)

    def equations(self, scene: Scene, state: State, h: Scalar) -> tuple[ImplicitStep, NodeVectors]:
        """Return the equations of a step of `h` s, and the start (n, 3) of Newton's iteration."""
        formula = self._formula(scene, state, h)
        return formula.step, _start(formula, state, _predicted(scene, state, h, formula.orders.used))

    def predict(self, scene: Scene, state: State, h: Scalar) -> NodeVectors:
        """Predict the positions (n, 3) after a step of `h` s from the history."""
        return _predicted(scene, state, h, self._orders(scene, state, h).used)

    def differs(self, scene: Scene, state: State, h: Scalar) -> Scalar:
        """Bound the distance in m of a node from `predict` after an accepted step."""
        share = self._formula(scene, state, h).share
        return DIAGONAL * self._allowed(scene, state, h) / share * scene.length_scale

    def begin(self, scene: Scene, state: State, h: Scalar, held: Flag) -> NewtonIteration:
        """Begin a step of `h` s in the state's stage."""
        step, guess = self.equations(scene, state, h)
        return begin(step, guess, self.linear, state.kept if self.inertia else None, held)

    def go_on(
        self, scene: Scene, state: State, h: Scalar, begun: NewtonIteration, factor: Factor
    ) -> tuple[NewtonIteration, Factor]:
        """Solve the equations of the step."""
        step, guess = self.equations(scene, state, h)
        tolerance = self._newton_share(scene, state, h) * self._allowed(scene, state, h) * scene.length_scale
        return go_on(scene, step, guess, begun, self.linear, factor, tolerance, self.max_iterations)

    def is_over(self, begun: NewtonIteration) -> Flag:
        """Return whether the iteration is over."""
        return begun.is_over(self.max_iterations)

    def restores(self, begun: NewtonIteration) -> Flag:
        """Return whether the iteration only recomputes a missing factor."""
        return begun.restores

    def iterate(self, begun: NewtonIteration) -> NodeVectors:
        """Return the iterate (n, 3)."""
        return begun.x

    def given_up(self, begun: NewtonIteration, when: Flag) -> NewtonIteration:
        """Let the iteration fail if `when`."""
        return begun.failing(when)

    def end(
        self, scene: Scene, state: State, h: Scalar, begun: NewtonIteration, factor: Factor
    ) -> ImplicitAttempt:
        """Judge the step."""
        formula = self._formula(scene, state, h)
        theta, step, order = formula.theta, formula.step, formula.orders.used
        predicted = _predicted(scene, state, h, order)
        mean_v = step.velocity(begun.x)
        mean_p = updated_rest_curvature(scene, step, begun.x)
        x, v = _whole(theta, begun.x, state.x), _whole(theta, mean_v, state.v)
        p = None if mean_p is None or state.p is None else _whole(theta, mean_p, state.p)
        change = self._filtered(scene, state, step, x - predicted, factor)
        errors = self._errors(scene, state, h, formula, x, p, change)
        cause = judge(scene, state, begun.converged, begun.indefinite, x, state.t + h, errors[1])
        next_h, next_order = self._next(h, order, errors, cause)
        acceleration = jnp.where(state.stage == IMPLICIT, step.acceleration(mean_v), (v - state.v) / h)
        kept = last_tangent(begun) if self.inertia else state.kept
        return ImplicitAttempt(
            x, v, p, acceleration, errors[1], cause, order, next_h, next_order, factor, kept,
            begun.iterations, begun.linear, begun.factors,
        )  # fmt: skip

    def _newton_share(self, scene: Scene, state: State, h: Scalar) -> Scalar:
        """Return `newton_share`, less for formulas that conserve energy or if errors of many steps add up."""
        if not self.inertia:
            return self.newton_share
        reduced = jnp.where(self.rho_infinity > 0, CONSERVING, _remembered(scene, h) ** ONE_SIGN)
        return jnp.where(state.stage == IMPLICIT, reduced, 1.0) * self.newton_share

    def _formula(self, scene: Scene, state: State, h: Scalar) -> "_Formula":
        orders = self._orders(scene, state, h)
        moves = state.stage == IMPLICIT if self.inertia else None
        formula = step_formula(h, state.history.steps, orders.used, moves, self.rho_infinity)
        step = formula.equations(scene, state.history, state.t, h)
        return _Formula(step, formula.theta, orders, formula.share)

    def _orders(self, scene: Scene, state: State, h: Scalar) -> "_Orders":
        history = state.history
        highest = jnp.asarray(self.max_order)
        orders = _Orders(jnp.asarray(1), jnp.clip(history.order, 1, highest), highest)
        if not self.inertia:
            return orders
        stable = self._stable_order(scene, h)
        # With inertia the error estimate needs a third point, and order 2 the velocity at the second.
        used = jnp.where(history.count > 2, jnp.clip(history.order, 2, stable), 1)
        moves = state.stage == IMPLICIT
        inertial = _Orders(jnp.asarray(2), used, stable)
        return select(moves, inertial, orders)

    def _stable_order(self, scene: Scene, h: Scalar) -> Count:
        """Return the largest stable order of a step with inertia, at least 2."""
        if scene.drag is None:
            return jnp.asarray(2)
        decay = 0.5 * jnp.min(scene.drag.coefficient / scene.mass)
        largest = jnp.where(self.rho_infinity > 0, 2, max(self.max_order, 2))
        return jnp.minimum(damped_order(h, decay), largest)

    def _filtered(
        self, scene: Scene, state: State, step: ImplicitStep, change: NodeVectors, factor: Factor
    ) -> NodeVectors:
        """Return corrector minus predictor, filtered in the first quasistatic step.

        The predictor of that step is an explicit Euler step, which overshoots modes that decay within the
        step. A solve with the tangent removes their part.
        """
        if scene.drag is None:
            return change
        pull = (scene.drag.coefficient / step.beta_h)[:, None] * change
        first = (state.stage != IMPLICIT) & (state.history.count == 1)

        def solve(pattern: Pattern, factor: Factor, pull: NodeVectors) -> NodeVectors:
            solution = self.linear.solve(pattern, factor, None, pull.reshape(-1), FORCING)
            return solution.x.reshape(pull.shape)

        return where_needed(first, solve, change, scene.sparsity, factor, pull)

    def _errors(
        self,
        scene: Scene,
        state: State,
        h: Scalar,
        formula: "_Formula",
        x: NodeVectors,
        p: HingeValues | None,
        change: NodeVectors,
    ) -> Float[Array, "3"]:
        """Estimate the local errors (3,) one order below, at, and one above the step's order.

        Their unit is the tolerance; the error of an order that cannot be used is infinite."""
        history, orders = state.history, formula.orders
        order = orders.used
        starts = history.count <= 1
        here = _size(scene, change, None)
        if p is not None and scene.plasticity is not None and state.p is not None:
            gap = _gap(p, history.p, extrapolation(h, history.steps, order + 1))
            flow = scene.plasticity.rate(scene.bending.hinges(state.x).curvature, state.p)
            gap = jnp.where(starts, p - state.p - h * flow, gap)
            here = jnp.maximum(here, 0.5 * jnp.max(jnp.abs(gap)))
        # The predictor of a start is an Euler step, whose error is minus that of the formula. The step that
        # aligns the velocity has no predictor, and may use the whole tolerance.
        share = jnp.where(starts, 0.5, formula.share)
        allowed = jnp.where(aligns(state), self.rtol, self._allowed(scene, state, h))
        errors = [jnp.asarray(jnp.inf), share * here / allowed, jnp.asarray(jnp.inf)]
        for place, other in ((0, order - 1), (2, order + 1)):
            known = (other >= orders.lowest) & (other < history.count) & (other <= orders.highest)
            used = jnp.clip(other, 1, self.max_order)
            weights = extrapolation(h, history.steps, used + 1)
            p_gap = None if p is None else _gap(p, history.p, weights)
            size = _size(scene, _gap(x, history.x, weights), p_gap)
            size = error_constant(h, history.steps, used) * size
            errors[place] = jnp.where(known, size / allowed, jnp.inf)
        return jnp.stack(errors)

    def _allowed(self, scene: Scene, state: State, h: Scalar) -> Scalar:
        """Return the tolerated local error of a step of `h` s, relative to the scales."""
        share = self.inertial_share * _remembered(scene, h)
        allowed = self.rtol * jnp.where(state.stage == IMPLICIT, share, LOCAL_SHARE)
        if scene.contact is None:
            return allowed
        largest = scene.contact.potential.error_share * scene.contact.range
        return jnp.minimum(allowed, largest / scene.length_scale)

    def _next(self, h: Scalar, order: Count, errors: Float[Array, "3"], cause: Count) -> tuple[Scalar, Count]:
        """Choose the next step and order: those with the longest predicted step."""
        orders = order + jnp.arange(-1, 2)
        reach = jnp.maximum(errors, 1e-10) ** (-1.0 / (orders + 1))
        best = jnp.argmax(reach * jnp.asarray([1.0, ORDER_GAIN, 1.0]))
        best = jnp.where((cause < 0) | (cause == CAUSES.index("error")), best, 1)
        return resized(h, orders[best], errors[best], cause), orders[best]


class _Orders(NamedTuple):
    """Hold the order of a step, and the lowest and highest order of the next one."""

    lowest: Count
    used: Count
    highest: Count


class _Formula(NamedTuple):
    """Hold a step's equations, theta and orders, and the error's share of corrector - predictor."""

    step: ImplicitStep
    theta: Scalar
    orders: _Orders
    share: Scalar


def _remembered(scene: Scene, h: Scalar) -> Scalar:
    """Return the reduction of a step's share of the tolerance if errors of many steps of `h` s add up.

    A wave decays as exp(-b t / 2m), and so do the local errors in it. The factor is below 1 if more than
    `REMEMBERED` steps fit into 2m/b.
    """
    steps = 2.0 * scene.inertial_time / h
    return jnp.clip(REMEMBERED / steps, REMEMBERED / MOST_REMEMBERED, 1.0)


def _predicted(scene: Scene, state: State, h: Scalar, order: Count) -> NodeVectors:
    """Extrapolate the positions (n, 3) from the history, or by the velocity if it has one point only."""
    history = state.history
    predicted = jnp.tensordot(extrapolation(h, history.steps, order + 1), history.x, 1)
    euler = state.x + jnp.where(aligns(state), 0.0, h) * state.v
    predicted = jnp.where(history.count <= 1, euler, predicted)
    return predicted if scene.prescribed is None else scene.prescribed.position(predicted, state.t + h)


def _start(formula: _Formula, state: State, predicted: NodeVectors) -> NodeVectors:
    """Return the predicted unknown of the formula, the weighted mean of new and old positions."""
    return formula.theta * predicted + (1.0 - formula.theta) * state.x


def _whole(
    theta: Scalar, mean: Float[Array, " *axes"], old: Float[Array, " *axes"]
) -> Float[Array, " *axes"]:
    """Recover the new value from the weighted mean of new and old."""
    return old + (mean - old) / theta


def _gap(
    new: Float[Array, " *axes"], past: Float[Array, " points *axes"] | None, weights: Float[Array, " points"]
) -> Float[Array, " *axes"]:
    """Return the difference of a new value from its prediction with `weights` (6,)."""
    assert past is not None
    return new - jnp.tensordot(weights, past, 1)


def _size(scene: Scene, x: NodeVectors, p: HingeValues | None) -> Scalar:
    size = jnp.max(jnp.abs(x)) / scene.length_scale
    return size if p is None else jnp.maximum(size, 0.5 * jnp.max(jnp.abs(p)))
