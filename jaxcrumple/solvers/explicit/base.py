"""Steps of the explicit stage: eq. (1) with plastic flow by an explicit method."""

import abc
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax.numpy as jnp

from jaxcrumple._jax.arrays import Count, Flag, HingeValues, NodeVectors, Scalar
from jaxcrumple._jax.tree import as_float
from jaxcrumple.geometry.hinge import longest
from jaxcrumple.scene import Scene
from jaxcrumple.solvers.contact.crossings import passes, unlisted_turn
from jaxcrumple.solvers.explicit.stability import Fastest, beside_walls
from jaxcrumple.state import CAUSES, Slopes, State
from jaxcrumple.system import rates


class Tried(NamedTuple):
    """Hold the result of a step: `x`, `v` (n, 3), `p` (h,) and the slopes at its end.

    `error`: estimated errors of x, v and p; None for a variable without an estimate."""

    x: NodeVectors
    v: NodeVectors
    p: HingeValues | None
    error: tuple[NodeVectors, NodeVectors | None, HingeValues | None]
    slopes: Slopes


class ExplicitAttempt(NamedTuple):
    """Hold a step attempt: new `x`, `v`, `p` and `slopes`.

    `error`: local error in units of the tolerance; `cause`: index into `CAUSES`, or -1 for an accepted step;
    `next_h`: next step in s; `turn`: `unlisted_turn` at `x`."""

    x: NodeVectors
    v: NodeVectors
    p: HingeValues | None
    slopes: Slopes
    error: Scalar
    cause: Count
    next_h: Scalar
    turn: Scalar

    @property
    def accepted(self) -> Flag:
        """Return whether the step is accepted."""
        return self.cause < 0


class AbstractExplicit(eqx.Module):
    """Define an explicit method and its options.

    - `rtol`: tolerance in the maximum norm: positions in units of $\\sqrt A$, p in units of 2, velocities in
      units of `Scene.velocity_scale`.
    - `safety`: largest step as a share of the estimated stability limit.
    """

    rtol: Scalar
    safety: Scalar = eqx.field(default=0.8, converter=as_float)
    # Order of the method, and order in the step size of its local error estimate.
    order: eqx.AbstractClassVar[int]
    error_order: eqx.AbstractClassVar[int]

    @staticmethod
    @abc.abstractmethod
    def stable(motion: Fastest) -> Scalar:
        """Return the largest stable step in s."""

    @abc.abstractmethod
    def step(self, scene: Scene, state: State, h: Scalar) -> Tried:
        """Make a step of `h` s from a state whose slopes are known."""

    @staticmethod
    @abc.abstractmethod
    def advance(
        scene: Scene, t: Scalar, h: Scalar, x: NodeVectors, v: NodeVectors, p: HingeValues | None
    ) -> tuple[NodeVectors, NodeVectors, HingeValues | None]:
        """Return positions and velocities (n, 3) and p after a step of `h` s from time `t`.

        The result equals that of `step`, without the error estimate; `replay` differentiates it."""

    def attempt(self, scene: Scene, state: State, h: Scalar, cap: Scalar) -> ExplicitAttempt:
        """Try a step of `h` s from a state whose slopes are known; the next step is at most `cap` s."""
        tried, t1 = self.step(scene, state, h), state.t + h
        units = jnp.maximum(self._units(scene, tried.error), self._jolt(scene, state, tried, h))
        finite = jnp.isfinite(units) & jnp.isfinite(jnp.sum(tried.x)) & jnp.isfinite(jnp.sum(tried.v))
        keep, next_h = self._resized(units, state.t, h, cap)
        next_h = jnp.where(finite, next_h, 0.25 * h)
        good = keep & finite
        unstable = h > beside_walls(scene, state.limit, tried.x, t1, self.stable)
        turn = unlisted_turn(scene, tried.x)
        stopped = good & (unstable | passes(scene, state, tried.x, t1, turn))
        next_h = jnp.where(stopped, 0.4 * h, next_h)
        cause = jnp.where(finite, CAUSES.index("error"), CAUSES.index("nonfinite"))
        cause = jnp.where(good, jnp.where(stopped, CAUSES.index("contact"), -1), cause)
        return ExplicitAttempt(tried.x, tried.v, tried.p, tried.slopes, units, cause, next_h, turn)

    def _units(
        self, scene: Scene, error: tuple[NodeVectors, NodeVectors | None, HingeValues | None]
    ) -> Scalar:
        """Return the error in units of the tolerance."""
        scales: tuple[Scalar, ...] = (scene.length_scale, scene.velocity_scale, jnp.asarray(2.0))
        parts = [jnp.max(jnp.abs(e)) / scale for e, scale in zip(error, scales, strict=True) if e is not None]
        return jnp.max(jnp.stack(parts)) / self.rtol

    def _jolt(self, scene: Scene, state: State, tried: Tried, h: Scalar) -> Scalar:
        """Return the change of forces over a step, in units of the largest that the step resolves.

        $h|a_1 - a_0|/|v|$ is $(h\\omega)^2$ for one mode. A mode that carries the largest speed must not move
        by more than 1 rad in a step; faster ones, up to the stability limit, carry less. This ends steps that
        fly into the steep part of a contact potential, to leave it with energy from nowhere: the stability
        limit was measured before, and does not tell.
        """
        a0, a1 = state.slopes.acceleration, tried.slopes.acceleration
        change, before, speed = map(longest, (a1 - a0, a0, state.v))
        speed = jnp.maximum(jnp.maximum(speed, 0.5 * h * before), self.rtol * scene.velocity_scale)
        # (h omega)^2 to the power with which the control of the step size expects errors to fall.
        return (h * change / speed) ** (0.5 * self.error_order)

    def _resized(self, units: Scalar, t: Scalar, h: Scalar, cap: Scalar) -> tuple[Flag, Scalar]:
        """Return whether the error `units` allows the step, and the next step in s."""
        from diffrax import PIDController

        controller = PIDController(rtol=0.0, atol=1.0, dtmax=cap)
        # An integral controller has no memory, so that each step initialises it. It needs the error alone,
        # and nothing of the equations.
        y, unasked = jnp.zeros(()), cast(Any, None)
        _, memory = controller.init(unasked, t, t + h, y, h, unasked, unasked, self.error_order)
        keep, start, end, _, _, _ = controller.adapt_step_size(
            t, t + h, y, y, unasked, units, self.error_order, memory
        )
        return jnp.asarray(keep), jnp.asarray(end - start)


def slopes_at(scene: Scene, x: NodeVectors, v: NodeVectors, p: HingeValues | None, t: Scalar) -> Slopes:
    """Compute the time derivatives of `v` (n, 3) and `p` (h,) at positions `x` (n, 3) and time `t`."""
    _, acceleration, flow = rates(scene, x, v, p, t)
    return Slopes(acceleration, flow, jnp.asarray(True))
