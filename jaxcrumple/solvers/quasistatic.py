"""One step of the quasistatic stage: the DAE (47)-(49) by variable-step BDF with an embedded error."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jax import Array

from jaxcrumple.model.geometry import curvature
from jaxcrumple.model.scene import Scene
from jaxcrumple.solvers.bdf import coefficients, extrapolation
from jaxcrumple.solvers.linear import AbstractLinearSolver, Factor
from jaxcrumple.solvers.newton import newton
from jaxcrumple.system import CAUSES, State, implicit_step, residual

# Largest growth of the step after a step of order 1 ... 4: below what variable-step BDF tolerates
# without losing zero-stability (1.62 and 1.28 at orders 3 and 4).
GROWTH = (2.0, 2.0, 1.5, 1.25)

# Share of the tolerance that one step's local error may use. Buckling amplifies what a step leaves
# behind up to fiftyfold; with this share the measured error of a run stays below rtol.
LOCAL_SHARE = 0.02
# Aim of the step control, and the smallest growth worth a change of step: with 0.8 and 1.1 one step in
# twelve is rejected on `radial`, with 0.9 and 1 one in six, for the same number of attempts.
SAFETY, WORTHWHILE = 0.8, 1.1


class Quasistatic(eqx.Module):
    """Options of the quasistatic stage.

    - `rtol`: tolerance on the local error in maximum norm: positions over $\\sqrt A$, p over 2.
    - `max_order`: 3 or 4: the step is taken with this order and its error is estimated with the order
      below (the paper's pair is 4 and 3).
    - `newton_share`: Newton's error as a share of what a step may leave.
    - `max_iterations`: Newton iterations before a step is rejected.
    - `linear`: the linear solver.
    """

    rtol: Array
    linear: AbstractLinearSolver
    newton_share: Array = eqx.field(default=0.05, converter=jnp.asarray)
    max_order: int = eqx.field(static=True, default=4)
    max_iterations: int = eqx.field(static=True, default=8)


class Attempt(NamedTuple):
    """A tried step: new `x`, `v`, `p`, its `error` in units of the tolerance and what it took.

    `cause` indexes `CAUSES`, or is -1 when the step is accepted.
    """

    x: Array
    v: Array
    p: Array | None
    error: Array
    cause: Array
    order: Array
    factor: Factor
    newton: Array
    linear: Array

    @property
    def accepted(self) -> Array:
        """Whether the step stands."""
        return self.cause < 0


def attempt(scene: Scene, state: State, h: Array, options: Quasistatic, factor: Factor) -> Attempt:
    """Try a quasistatic step of size `h`."""
    history = state.history
    order = jnp.clip(history.count, 1, options.max_order)
    alpha, beta_h = coefficients(h, history.steps, order)
    step = implicit_step(scene, history, alpha, beta_h, state.t + h)
    guess = jnp.tensordot(extrapolation(h, history.steps, jnp.maximum(history.count, 1)), history.x, 1)
    if scene.prescribed is not None:
        guess = scene.prescribed.position(guess, step.t)
    tolerance = LOCAL_SHARE * options.rtol * scene.length_scale
    solution = newton(
        scene, step, guess, options.linear, factor, options.newton_share * tolerance, options.max_iterations
    )  # fmt: skip
    v = step.velocity(solution.x)
    _, p = residual(scene, step, solution.x)
    error = _error(scene, state, h, order, solution.x, p, solution.factor, options)
    cause = _cause(scene, state, solution, error)
    linear = solution.linear + 1
    return Attempt(solution.x, v, p, error, cause, order, solution.factor, solution.iterations, linear)


def _error(scene: Scene, state: State, h, order, x, p, factor: Factor, options: Quasistatic) -> Array:
    """Local error over the tolerance: the distance to the solution of the order below.

    That solution is one linearised solve away: its residual at the new x, and the factor at hand. At
    order 1 the comparison is with an explicit Euler step. An aligning step has no velocity to
    compare with; it may move no further than the whole tolerance.
    """
    lower = jnp.maximum(order - 1, 1)
    alpha, beta_h = coefficients(h, state.history.steps, lower)
    step = implicit_step(scene, state.history, alpha, beta_h, state.t + h)
    value, _ = residual(scene, step, x)
    aligning, first = state.history.count == 0, order == 1
    euler = 0.5 * (x - state.x - jnp.where(aligning, 0.0, h) * state.v)
    unbalance = -value
    if scene.drag is not None:
        # Explicit Euler overshoots what decays within the step; the tangent filters that out.
        pull = (scene.drag.coefficient / step.beta_h)[:, None] * euler
        unbalance = jnp.where(first & ~aligning, pull, unbalance)
    correction = options.linear.solve(scene.pattern, factor, unbalance.reshape(-1)).x.reshape(x.shape)
    unfiltered = aligning if scene.drag is not None else first
    share = options.rtol * jnp.where(aligning, 1.0, LOCAL_SHARE)
    position = jnp.max(jnp.abs(jnp.where(unfiltered, euler, correction))) / scene.length_scale
    if p is None or state.p is None or scene.plasticity is None:
        return position / share
    _, p_lower = residual(scene, step, x + correction)
    c = curvature(scene.bending.hinges(state.x).theta)
    flow = 0.5 * (p - state.p - h * scene.plasticity.rate(c, state.p))
    rest = jnp.where(first, flow, p_lower - p)
    return jnp.maximum(position, 0.5 * jnp.max(jnp.abs(rest))) / share


def _cause(scene: Scene, state: State, solution, error: Array) -> Array:
    """Index into `CAUSES` of what forbids the step, or -1."""
    before = scene.bending.hinges(state.x).theta
    after = scene.bending.hinges(solution.x).theta
    finite = jnp.all(jnp.isfinite(solution.x)) & jnp.isfinite(error)
    # An angle that passes 180 degrees reappears with the other sign: it jumps by more than pi.
    flipped = jnp.max(jnp.abs(after - before)) > jnp.pi
    checks = {
        "nonfinite": ~finite,
        "newton": ~solution.converged,
        "unstable": solution.indefinite,
        "fold": flipped,
        "error": error > 1.0,
    }
    cause = jnp.asarray(-1)
    for name in reversed(checks):
        cause = jnp.where(checks[name], CAUSES.index(name), cause)
    # An indefinite matrix explains a failed iteration better than the failure itself.
    return jnp.where(finite & solution.indefinite, CAUSES.index("unstable"), cause)


def next_step(tried: Attempt, h: Array) -> Array:
    """Step size after an attempt: from the error if it was judged by it, else a fixed cut."""
    exponent = -1.0 / jnp.maximum(tried.order, 2)
    by_error = SAFETY * jnp.maximum(tried.error, 1e-10) ** exponent
    growth = jnp.asarray(GROWTH)[tried.order - 1]
    accepted = jnp.clip(by_error, 0.2, growth)
    accepted = jnp.where((accepted > 1.0) & (accepted < WORTHWHILE), 1.0, accepted)
    rejected = jnp.where(tried.cause == CAUSES.index("error"), jnp.clip(by_error, 0.1, 0.8), 0.4)
    return h * jnp.where(tried.accepted, accepted, rejected)
