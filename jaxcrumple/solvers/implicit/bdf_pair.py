"""The paper's quasistatic step: two BDF solutions, of orders 4 and 3, whose difference is the error."""

import equinox as eqx
import jax.numpy as jnp

from jaxcrumple._jax.arrays import Count, Flag, HingeValues, NodeVectors, Scalar
from jaxcrumple._jax.tree import as_float
from jaxcrumple.geometry.hinge import curvature
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
from jaxcrumple.solvers.implicit.newton import FORCING, NewtonSolution, newton
from jaxcrumple.solvers.linear.base import AbstractLinearSolver, Factor
from jaxcrumple.state import State
from jaxcrumple.system import residual

# Order of the paper's solution, and number of points of its predictor.
ORDER, PREDICTOR_POINTS = 4, 4


class BDFPair(AbstractImplicit):
    """Implement the paper's step of order s, with the error from a second solve of order s - 1 (Section 3.2).

    The order is 4 as soon as the history is long enough. The step has no inertia, because the explicit stage
    integrates snaps. Fields as in `VariableOrder`.
    """

    rtol: Scalar
    linear: AbstractLinearSolver
    newton_share: Scalar = eqx.field(default=0.05, converter=as_float)
    max_iterations: int = eqx.field(static=True, default=8)

    def predict(self, scene: Scene, state: State, h: Scalar) -> NodeVectors:
        """Predict the positions (n, 3) after a step of `h` s from the history."""
        history = state.history
        points = jnp.clip(history.count, 1, PREDICTOR_POINTS)
        guess = jnp.tensordot(extrapolation(h, history.steps, points), history.x, 1)
        return guess if scene.prescribed is None else scene.prescribed.position(guess, state.t + h)

    def differs(self, scene: Scene, state: State, h: Scalar) -> Scalar:
        """Return 0, unknown: the error estimate does not use the predictor."""
        return jnp.zeros(())

    def attempt(self, scene: Scene, state: State, h: Scalar, factor: Factor, held: Flag) -> ImplicitAttempt:
        """Try a step of `h` s."""
        history = state.history
        order = jnp.clip(history.count, 1, ORDER)
        step = _equations(scene, state, h, order)
        solution = self._newton(scene, step, self.predict(scene, state, h), factor)
        x, v = solution.x, step.velocity(solution.x)
        _, p = residual(scene, step, x)
        lower = _equations(scene, state, h, jnp.maximum(order - 1, 1))
        second = self._newton(scene, lower, x, solution.factor)
        first_step = self._first_error(scene, state, step, x, h, second.factor)
        error = self._error(scene, state, h, order, (x, p), lower, second, first_step)
        both = solution._replace(
            converged=solution.converged & second.converged,
            indefinite=solution.indefinite | second.indefinite,
        )
        cause = judge(scene, state, both, x, state.t + h, error)
        next_h = resized(h, order, error, cause, jnp.maximum(order - 1, 1))
        return ImplicitAttempt(
            x, v, p, (v - state.v) / h, error, cause, order, next_h, history.order, second.factor, state.kept,
            solution.iterations + second.iterations, solution.linear + second.linear,
            solution.factors + second.factors, solution.restored,
        )  # fmt: skip

    def _newton(self, scene: Scene, step: ImplicitStep, guess: NodeVectors, factor: Factor) -> NewtonSolution:
        tolerance = self.newton_share * LOCAL_SHARE * self.rtol * scene.length_scale
        yes = jnp.asarray(True)
        return newton(scene, step, guess, self.linear, factor, tolerance, self.max_iterations, None, yes)

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
        second: NewtonSolution,
        first_step: NodeVectors,
    ) -> Scalar:
        """Return the difference of the two solutions in units of the tolerance.

        At order 1 it is the difference from an explicit Euler step."""
        x, p = upper
        gap = jnp.where(order == 1, first_step, second.x - x)
        position = jnp.max(jnp.abs(gap)) / scene.length_scale
        share = self.rtol * jnp.where(aligns(state), 1.0, LOCAL_SHARE)
        if p is None or state.p is None or scene.plasticity is None:
            return position / share
        _, p_lower = residual(scene, lower, second.x)
        c = curvature(scene.bending.hinges(state.x).theta)
        flow = 0.5 * (p - state.p - h * scene.plasticity.rate(c, state.p))
        rest = jnp.where(order == 1, flow, p_lower - p)  # type: ignore[operator]
        return jnp.maximum(position, 0.5 * jnp.max(jnp.abs(rest))) / share


def _equations(scene: Scene, state: State, h: Scalar, order: Count) -> ImplicitStep:
    alpha, beta_h = coefficients(h, state.history.steps, order)
    return implicit_step(scene, state.history, alpha, beta_h, state.t + h)
