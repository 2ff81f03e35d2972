"""Past points of the implicit stages, and what an implicit step takes from them."""

from typing import Any, Protocol

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxcrumple._jax.arrays import Count, HingeValues, NodeVectors, Scalar
from jaxcrumple.scene import Scene

# Points in the multistep history: BDF5 and the predictor of its error estimate need 6.
HISTORY = 6
# Age that marks a tangent as unusable.
NEVER = 1_000_000


class History(eqx.Module):
    """Hold the accepted points of the implicit stages, newest first.

    `x` and `v` (6, n, 3); `p` (6, h) or None; `steps` (6,) in s: `steps[j]` is the time between
    points j and j+1; `count`: number of valid points. 0 means one point whose velocity need not balance
    the forces (a start, or the end of an explicit stage); the next quasistatic step then aligns it.
    `order`: order of the next step, if its stage allows that order.
    """

    x: Float[Array, " points *axes"]
    v: Float[Array, " points *axes"]
    p: Float[Array, "points hinges"] | None
    steps: Float[Array, " points"]
    count: Count
    order: Count


class ImplicitStep(eqx.Module):
    """Hold the history sums of an implicit step: $\\dot y = (y + \\sum_j \\alpha_j y_j)/(\\beta h)$ (eq. 39).

    `t`: time of the equations in s; `beta_h` in s; `x_memory` (n, 3), `p_memory` (h,), `damping_memory` and
    `v_memory` (n, 3): $\\sum_j \\alpha_j y_j$; `v_memory` is None if no stage has inertia.
    `inertia` is 1 with the inertial force and 0 without.
    """

    t: Scalar
    beta_h: Scalar
    x_memory: NodeVectors
    v_memory: NodeVectors | None
    p_memory: HingeValues | None
    damping_memory: Any
    inertia: Scalar

    def velocity(self, x: NodeVectors) -> NodeVectors:
        """Return the velocity (n, 3) of the formula at new positions `x`."""
        return (x + self.x_memory) / self.beta_h

    def acceleration(self, v: NodeVectors) -> NodeVectors:
        """Return the acceleration (n, 3) of the formula at new velocities `v`; 0 without inertia."""
        if self.v_memory is None:
            return jnp.zeros_like(v)
        return self.inertia * (v + self.v_memory) / self.beta_h


class Points(Protocol):
    """Describe past points, newest first: positions and velocities (6, n, 3), p (6, h) or None."""

    @property
    def x(self) -> Float[Array, "points nodes 3"]:
        """Positions in m."""

    @property
    def v(self) -> Float[Array, "points nodes 3"]:
        """Velocities in m/s."""

    @property
    def p(self) -> Float[Array, "points hinges"] | None:
        """Rest curvatures."""


def implicit_step(
    scene: Scene,
    history: Points,
    alpha: Float[Array, " points"],
    beta_h: Scalar,
    t: Scalar,
    inertia: Scalar | None = None,
) -> ImplicitStep:
    """Build the implicit step with equations at time `t` and coefficients `alpha` (6,) of the history.

    `inertia` is 0 or 1, or None if no stage has inertia."""
    return ImplicitStep(
        t=t,
        beta_h=beta_h,
        x_memory=jnp.tensordot(alpha, history.x, 1),
        v_memory=None if inertia is None else jnp.tensordot(alpha, history.v, 1),
        p_memory=None if history.p is None else alpha @ history.p,
        damping_memory=None if scene.damping is None else scene.damping.memory(history.x, alpha),
        inertia=jnp.zeros(()) if inertia is None else inertia,
    )


class Linearization(eqx.Module):
    """Record where a tangent was computed: in which `step`, at positions `x` (n, 3), `age` steps ago."""

    step: ImplicitStep
    x: NodeVectors
    age: Count


def restart_history(x: NodeVectors, v: NodeVectors, p: HingeValues | None) -> History:
    """Return a history of the current point alone; its velocity need not balance the forces."""

    def repeat(a: Float[Array, " *axes"], times: int) -> Float[Array, " times *axes"]:
        return jnp.broadcast_to(a, (times, *a.shape))

    past = None if p is None else repeat(p, HISTORY)
    one = jnp.asarray(1, int)
    return History(repeat(x, HISTORY), repeat(v, HISTORY), past, jnp.ones(HISTORY), one - 1, one)


def no_linearization(scene: Scene, history: History) -> Linearization:
    """Return a linearization that no step may use."""
    nought, one = jnp.zeros(()), jnp.ones(())
    step = implicit_step(scene, history, jnp.zeros(HISTORY), one, nought, nought)
    return Linearization(step, history.x[0], jnp.asarray(NEVER, int))
