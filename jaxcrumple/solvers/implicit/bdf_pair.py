"""The paper's quasistatic step: two BDF solutions, of orders 4 and 3, whose difference is the error."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp

from jaxcrumple._jax.arrays import Count, Flag, HingeValues, NodeVectors, Scalar
from jaxcrumple._jax.tree import as_float, select
from jaxcrumple.history import ImplicitStep, implicit_step
from jaxcrumple.scene import Scene
from jaxcrumple.solvers.implicit.base import (
    LOCAL_SHARE,
    AbstractImplicit,
    ImplicitAttempt,
    aligns,
    judge,
    resized,
)
from jaxcrumple.solvers.implicit.bdf import coefficients, extrapolation
from jaxcrumple.solvers.implicit.newton import FORCING, NewtonIteration, begin, go_on
from jaxcrumple.solvers.linear.base import AbstractLinearSolver, Factor
from jaxcrumple.state import State
from jaxcrumple.system import updated_rest_curvature

# Order of the paper's solution, and number of points of its predictor.
ORDER, PREDICTOR_POINTS = 4, 4


class _Pair(NamedTuple):
    """Hold the solves of a step: the current `iteration`, and whether it is the `second`; solution `first`
    (n, 3) of order s, and what it took."""

    iteration: NewtonIteration
    second: Flag
    first: NodeVectors
    iterations: Count
    linear: Count
    factors: Count


class BDFPair(AbstractImplicit):
    """Implement the paper's step of order s, with the error from a second solve of order s - 1 (Section 3.2).

    The order is 4 as soon as the history is long enough. The step has no inertia, because the explicit stage
    integrates snaps. Fields as in `VariableOrder`.
    """

    rtol: Scalar
    linear: AbstractLinearSolver
    newton_share: Scalar = eqx.field(default=0.05, converter=as_float)
    max_iterations: int = eqx.field(static=True, default=20)

    def predict(self, scene: Scene, state: State, h: Scalar) -> NodeVectors:
        """Predict the positions (n, 3) after a step of `h` s from the history."""
        history = state.history
        points = jnp.clip(history.count, 1, PREDICTOR_POINTS)
        guess = jnp.tensordot(extrapolation(h, history.steps, points), history.x, 1)
        return guess if scene.prescribed is None else scene.prescribed.position(guess, state.t + h)

    def differs(self, scene: Scene, state: State, h: Scalar) -> Scalar:
        """Return 0, unknown: the error estimate does not use the predictor."""
        return jnp.zeros(())

    def begin(self, scene: Scene, state: State, h: Scalar, held: Flag) -> "_Pair":
        """Begin a step of `h` s with the solve of order s."""
        step = _equations(scene, state, h, _order(state))
        return self._begun(step, self.predict(scene, state, h), jnp.asarray(False))

    def _begun(self, step: ImplicitStep, guess: NodeVectors, second: Flag) -> "_Pair":
        zero = jnp.asarray(0)
        iteration = begin(step, guess, self.linear, None, jnp.asarray(True))
        return _Pair(iteration, second, guess, zero, zero, zero)

    def go_on(
        self, scene: Scene, state: State, h: Scalar, begun: "_Pair", factor: Factor
    ) -> tuple["_Pair", Factor]:
        """Go on with the first solve, or with the second one; begin the second after the first."""
        order = _order(state)
        lower = _equations(scene, state, h, _lower(order))
        step = select(begun.second, lower, _equations(scene, state, h, order))
        guess = jnp.where(begun.second, begun.first, self.predict(scene, state, h))
        tolerance = self.newton_share * LOCAL_SHARE * self.rtol * scene.length_scale
        found, factor = go_on(
            scene, step, guess, begun.iteration, self.linear, factor, tolerance, self.max_iterations
        )
        begun = begun._replace(iteration=found)
        after = self._begun(lower, found.x, jnp.asarray(True))._replace(
            iterations=found.iterations, linear=found.linear, factors=found.factors
        )
        return select(~begun.second & found.converged, after, begun), factor

    def is_over(self, begun: "_Pair") -> Flag:
        """Return whether both solves are over, or the first failed."""
        return begun.iteration.is_over(self.max_iterations)

    def restores(self, begun: "_Pair") -> Flag:
        """Return False: no factor is lagged from an earlier step."""
        return jnp.asarray(False)

    def iterate(self, begun: "_Pair") -> NodeVectors:
        """Return the iterate (n, 3)."""
        return begun.iteration.x

    def given_up(self, begun: "_Pair", when: Flag) -> "_Pair":
        """Let the iteration fail if `when`."""
        return begun._replace(iteration=begun.iteration.failing(when))

    def end(self, scene: Scene, state: State, h: Scalar, begun: "_Pair", factor: Factor) -> ImplicitAttempt:
        """Judge the step."""
        order, found = _order(state), begun.iteration
        step, lower = (_equations(scene, state, h, s) for s in (order, _lower(order)))
        x, v = begun.first, step.velocity(begun.first)
        p = updated_rest_curvature(scene, step, x)
        first_step = self._first_error(scene, state, step, x, h, factor)
        error = self._error(scene, state, h, order, (x, p), lower, found.x, first_step)
        converged = begun.second & found.converged
        cause = judge(scene, state, converged, found.indefinite, x, state.t + h, error)
        next_h = resized(h, order, error, cause, _lower(order))
        return ImplicitAttempt(
            x, v, p, (v - state.v) / h, error, cause, order, next_h, state.history.order, factor, state.kept,
            begun.iterations + found.iterations, begun.linear + found.linear, begun.factors + found.factors,
        )  # fmt: skip

    def _first_error(
        self, scene: Scene, state: State, step: ImplicitStep, x: NodeVectors, h: Scalar, factor: Factor
    ) -> NodeVectors:
        """Return half the difference from an explicit Euler step; a solve with the tangent removes the modes
        that decay within the step."""
        euler = 0.5 * (x - state.x - jnp.where(aligns(state), 0.0, h) * state.v)
        if scene.drag is None:
            return euler
        pull = ((scene.drag.coefficient / step.beta_h)[:, None] * euler).reshape(-1)
        filtered = self.linear.solve(scene.sparsity, factor, None, pull, FORCING).x
        return jnp.where(aligns(state), euler, filtered.reshape(x.shape))

    def _error(
        self,
        scene: Scene,
        state: State,
        h: Scalar,
        order: Count,
        upper: tuple[NodeVectors, HingeValues | None],
        lower: ImplicitStep,
        second: NodeVectors,
        first_step: NodeVectors,
    ) -> Scalar:
        """Return the difference of the two solutions in units of the tolerance.

        At order 1 it is the difference from an explicit Euler step."""
        x, p = upper
        gap = jnp.where(order == 1, first_step, second - x)
        position = jnp.max(jnp.abs(gap)) / scene.length_scale
        share = self.rtol * jnp.where(aligns(state), 1.0, LOCAL_SHARE)
        if p is None or state.p is None or scene.plasticity is None:
            return position / share
        p_lower = updated_rest_curvature(scene, lower, second)
        c = scene.bending.hinges(state.x).curvature
        flow = 0.5 * (p - state.p - h * scene.plasticity.rate(c, state.p))
        rest = jnp.where(order == 1, flow, p_lower - p)  # type: ignore[operator]
        return jnp.maximum(position, 0.5 * jnp.max(jnp.abs(rest))) / share


def _equations(scene: Scene, state: State, h: Scalar, order: Count) -> ImplicitStep:
    alpha, beta_h = coefficients(h, state.history.steps, order)
    return implicit_step(scene, state.history, alpha, beta_h, state.t + h)


def _order(state: State) -> Count:
    """Return the order s of the next step."""
    return jnp.clip(state.history.count, 1, ORDER)


def _lower(order: Count) -> Count:
    """Return the order of the second solve."""
    return jnp.maximum(order - 1, 1)
