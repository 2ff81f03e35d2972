"""One step of the dynamic stage: eq. (1) with plastic flow by an explicit 4(3) Runge-Kutta pair."""

from functools import partial
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from jaxcrumple.model.bending import stop_derivatives
from jaxcrumple.model.fields import as_float
from jaxcrumple.model.geometry import gather, hinge_gradient, length, outer, sub
from jaxcrumple.model.scene import Scene
from jaxcrumple.solvers.lists import passes
from jaxcrumple.state import CAUSES, State
from jaxcrumple.system import rates

# Stability of the method on the imaginary axis (2.83) and on the negative real axis (2.79).
STABILITY = 2.75
# Local error of the embedded third-order solution is of the fourth power of the step.
ERROR_ORDER = 4


class RK43(diffrax.AbstractERK):
    """Kutta's 3/8 rule (order 4) with an embedded third-order method on an extra, reused stage."""

    tableau = diffrax.ButcherTableau(
        c=np.array([1 / 3, 2 / 3, 1.0, 1.0]),
        a_lower=(
            np.array([1 / 3]),
            np.array([-1 / 3, 1.0]),
            np.array([1.0, -1.0, 1.0]),
            np.array([1 / 8, 3 / 8, 3 / 8, 1 / 8]),
        ),
        b_sol=np.array([1 / 8, 3 / 8, 3 / 8, 1 / 8, 0.0]),
        b_error=np.array([1 / 8 - 1 / 12, 3 / 8 - 1 / 2, 3 / 8 - 1 / 4, 1 / 8, -1 / 6]),
    )
    interpolation_cls = diffrax.ThirdOrderHermitePolynomialInterpolation.from_k

    def order(self, terms) -> int:
        """Order of the solution."""
        return 4


# The stages of a step that is accepted: their times, and rows of the tableau.
_TIMES = np.append(0.0, RK43.tableau.c[:-1])
_STAGES = np.zeros((len(_TIMES), len(_TIMES)))
for _number, _row in enumerate(RK43.tableau.a_lower[:-1], 1):
    _STAGES[_number, : len(_row)] = _row


class Explicit(eqx.Module):
    """Options of the explicit stage.

    - `rtol`: tolerance in maximum norm: positions over $\\sqrt A$, p over 2, velocities over
      `Scene.velocity_scale`.
    - `safety`: share of the estimated stability limit that a step may take.
    """

    rtol: Array
    safety: Array = eqx.field(default=0.8, converter=as_float)


class Attempt(NamedTuple):
    """A tried step: new `x`, `v`, `p`, the `acceleration` there (n, 3), its `error` in units of the
    tolerance, the step to try next, and the stage handed on. `cause` is an index into `CAUSES`, or
    -1 when the step is accepted."""

    x: Array
    v: Array
    p: Array | None
    acceleration: Array
    error: Array
    cause: Array
    next_h: Array
    stages: Any

    @property
    def accepted(self) -> Array:
        """Whether the step stands."""
        return self.cause < 0


def stability_limit(scene: Scene, x: Array, t: ArrayLike = 0.0) -> Array:
    """Largest stable explicit step in s at positions `x` and time `t`, from element-wise eigenvalue bounds.

    For a spring $(\\hat r\\cdot(u_i - u_j))^2 \\le 2(\\hat r\\cdot u_i)^2 + 2(\\hat r\\cdot u_j)^2$, and
    for a hinge the factor is 4, so twice (four times) the nodes' own blocks bound the spectrum; on
    the hexagonal lattice the spring bound is sharp ($6 k_s/m$). Damping enters as $\\omega^2
    b_{int}/k_s + b_{iso}/m$, the largest decay rate.
    """
    omega_sq = jnp.max(largest_eigenvalue(_stiffness_bound(scene, x, t)) / scene.mass)
    decay = jnp.zeros(())
    if scene.damping is not None:
        decay = decay + omega_sq * jnp.max(scene.damping.coefficient / scene.membrane.stiffness)
    if scene.drag is not None:
        decay = decay + jnp.max(scene.drag.coefficient / scene.mass)
    return STABILITY / jnp.maximum(jnp.sqrt(omega_sq), decay)


def largest_eigenvalue(a: Array) -> Array:
    """Largest eigenvalue (n,) of symmetric matrices (n, 3, 3) in closed form (Smith, CACM 4, 1961, 168).

    Not by LAPACK: XLA runs a batch of such calls on its thread pool and waits there, so that two of them
    at once hang a pool of two threads.
    """
    mean = jnp.trace(a, axis1=1, axis2=2) / 3.0
    rest = a - mean[:, None, None] * jnp.eye(3)
    size = jnp.sqrt(jnp.sum(rest * rest, axis=(1, 2)) / 6.0)
    c = [rest[:, i] for i in range(3)]
    determinant = jnp.sum(c[0] * jnp.cross(c[1], c[2]), axis=1)
    scale = jnp.where(size > 0, size, 1.0)
    angle = jnp.arccos(jnp.clip(determinant / (2.0 * scale**3), -1.0, 1.0)) / 3.0
    return mean + 2.0 * size * jnp.cos(angle)


def _stiffness_bound(scene: Scene, x: Array, t: ArrayLike) -> Array:
    """Node blocks (n, 3, 3) in N/m whose largest eigenvalue over m bounds omega^2."""
    bound = jnp.zeros((x.shape[0], 3, 3))
    xi, xj = gather(x, scene.membrane.nodes)
    r = sub(xi, xj)
    spring = 2.0 * scene.membrane.stiffness / length(r) ** 2 * outer(r, r)
    for k in range(2):
        bound = bound.at[scene.membrane.nodes[:, k]].add(jnp.moveaxis(spring, -1, 0))
    hinges = scene.bending.hinges(x)
    gradient = hinge_gradient(hinges)
    # Within the fold stop its own stiffness dominates.
    _, stop = stop_derivatives(hinges.theta)
    stiffness = 4.0 * scene.bending.stiffness * (1.0 + stop)
    for k, g in enumerate((gradient.g0, gradient.g1, gradient.g2, gradient.g3)):
        block = stiffness * outer(g, g)
        bound = bound.at[scene.bending.nodes[:, k]].add(jnp.moveaxis(block, -1, 0))
    for wall in scene.walls:
        bound = bound + wall.stiffness_bound(x, jnp.asarray(t))[:, None, None] * jnp.eye(3)
    if scene.contact is not None:
        bound = bound + scene.contact.stiffness_bound(x)[:, None, None] * jnp.eye(3)
    return bound


def _field(t, y, scene: Scene):
    x, v, p = y
    return rates(scene, x, v, p, t)


_TERM = diffrax.ODETerm(_field)
_SOLVER = RK43()


def _controller(scene: Scene, options: Explicit, cap: Array) -> diffrax.PIDController:
    norm = partial(_error_norm, scene, options)
    return diffrax.PIDController(rtol=0.0, atol=1.0, norm=norm, dtmax=cap)


def _error_norm(scene: Scene, options: Explicit, error) -> Array:
    """Error (x, v, p) in units of the tolerance."""
    x, v, p = error
    parts = [jnp.max(jnp.abs(x)) / scene.length_scale, jnp.max(jnp.abs(v)) / scene.velocity_scale]
    if p is not None:
        parts.append(0.5 * jnp.max(jnp.abs(p)))
    return jnp.max(jnp.stack(parts)) / options.rtol


def first_stages(scene: Scene, state: State):
    """The stage that a step hands to the next, for a step that has none before it."""
    y = (state.x, state.v, state.p)
    return _SOLVER.init(_TERM, state.t, state.t + state.h_explicit, y, scene)


def advance(
    scene: Scene, t: Array, h: Array, x: Array, v: Array, p: Array | None
) -> tuple[Array, Array, Array | None]:
    """Positions and velocities (n, 3) and p a step of `h` s after time `t`: what `attempt` accepts, without
    its error, to be differentiated."""
    y = (x, v, p)

    def moved(slopes, weights: Array):
        return jax.tree.map(lambda y, k: y + h * jnp.tensordot(weights, k, 1), y, slopes)

    def stage(slopes, row: tuple[Array, Array, Array]):
        number, c, weights = row
        x, v, p = moved(slopes, weights)
        slope = rates(scene, x, v, p, t + c * h)
        return jax.tree.map(lambda all, k: all.at[number].set(k), slopes, slope), None

    # One stage is compiled, and differentiated, for all of them.
    slopes = jax.tree.map(lambda y: jnp.zeros((len(_STAGES), *y.shape)), y)
    rows = jnp.arange(len(_STAGES)), jnp.asarray(_TIMES), jnp.asarray(_STAGES)
    slopes, _ = jax.lax.scan(stage, slopes, rows)
    x, v, p = moved(slopes, jnp.asarray(RK43.tableau.b_sol[:-1]))
    if scene.prescribed is None:
        return x, v, p
    return scene.prescribed.position(x, t + h), scene.prescribed.velocity(v, t + h), p


def attempt(
    scene: Scene, state: State, h: Array, cap: Array, stages, fresh: Array, options: Explicit
) -> Attempt:
    """Try an explicit step of size `h`; `fresh` says that `stages` must be computed anew."""
    y0 = (state.x, state.v, state.p)
    t1 = state.t + h
    # A stage handed on is that of the point before supports are put in their places.
    anew = fresh if scene.prescribed is None else jnp.asarray(True)
    y1, error, _, stages, _ = _SOLVER.step(_TERM, state.t, t1, y0, scene, stages, anew)
    controller = _controller(scene, options, cap)
    # The derivative at the new point is in the error alone.
    units = _error_norm(scene, options, error)
    finite = jnp.isfinite(units) & jnp.all(jnp.stack([jnp.all(jnp.isfinite(y)) for y in jax.tree.leaves(y1)]))
    # An integral controller keeps no memory, so its state starts afresh with every step.
    _, memory = controller.init(_TERM, state.t, t1, y0, h, scene, _SOLVER.func, ERROR_ORDER)
    keep, next_t0, next_t1, _, _, _ = controller.adapt_step_size(
        state.t, t1, y0, y1, scene, error, ERROR_ORDER, memory
    )
    next_h = jnp.where(finite, next_t1 - next_t0, 0.25 * h)
    x, v, p = y1
    if scene.prescribed is not None:
        x, v = scene.prescribed.position(x, t1), scene.prescribed.velocity(v, t1)
    good = keep & finite
    stopped = good & passes(scene, state, x, t1)
    next_h = jnp.where(stopped, 0.4 * h, next_h)
    cause = jnp.where(finite, CAUSES.index("error"), CAUSES.index("nonfinite"))
    cause = jnp.where(good, jnp.where(stopped, CAUSES.index("contact"), -1), cause)
    # The stage handed on is the derivative at the new point: the acceleration comes for free.
    _, (_, acceleration, _) = stages
    return Attempt(x, v, p, acceleration, units, cause, next_h, stages)
