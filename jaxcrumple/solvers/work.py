"""The work ledger: what walls and supports put into a sheet, and where it goes, step by step.

Between the ends of an accepted step, of any stage, positions follow the cubic through both with both
velocities. Along that path the sheet obeys the equations of motion but for a residual force $r = M\\ddot x
- F$, so that

$$\\Delta E = W_{walls} + W_{supports} + W_{drag} + W_{damping} + W_{plastic} + W_{numerical},$$

with $W_{numerical} = \\int r\\cdot\\dot x\\,dt$ the work that a method does for which there is no cause:
what it dissipates, and what is left out in the quasistatic stage and in changes of stage. All are
integrated by Gauss's rule with two points. The balance of energies, which are known without any path, is
the check of the ledger.
"""

import jax
import jax.numpy as jnp
from jax import Array

from jaxcrumple.scene import Scene
from jaxcrumple.state import State, Work
from jaxcrumple.system import energies, force

# Gauss's points on (0, 1); both weigh one half.
POINTS = (0.5 - 0.5 / 3.0**0.5, 0.5 + 0.5 / 3.0**0.5)


def booked(scene: Scene, before: State, after: State, h: Array) -> Work:
    """The ledger after an accepted step of `h` s between two states."""
    assert before.work is not None

    def at(share: Array) -> Work:
        return _power(scene, before, after, h, share)

    powers = jax.lax.map(at, jnp.asarray(POINTS))
    return jax.tree.map(lambda old, power: old + h * jnp.mean(power), before.work, powers)


def _power(scene: Scene, before: State, after: State, h: Array, s: Array) -> Work:
    """Power in W of all that does work, at the share `s` of a step's way."""
    x, v, a = _path(before, after, h, s)
    t = before.t + s * h
    p, flow = before.p, None
    if before.p is not None and after.p is not None:
        p, flow = before.p + s * (after.p - before.p), (after.p - before.p) / h
    rest = scene.mass[:, None] * a - force(scene, x, v, p, t)
    free = rest if scene.prescribed is None else scene.prescribed.free(rest, t)
    zero = jnp.zeros(())

    def stored(t: Array, p: Array | None) -> Array:
        parts = energies(scene, x, v, p, t)
        return parts.confinement + parts.extra + parts.bending

    _, walls = jax.jvp(lambda t: stored(t, p), (t,), (jnp.ones_like(t),))
    plastic = zero if p is None else jax.jvp(lambda p: stored(t, p), (p,), (flow,))[1]
    return Work(
        walls=walls,
        supports=jnp.sum((rest - free) * v),
        drag=zero if scene.drag is None else jnp.sum(scene.drag.force(v) * v),
        damping=zero if scene.damping is None else jnp.sum(scene.damping.force(x, v) * v),
        plastic=plastic,
        numerical=jnp.sum(free * v),
    )


def _path(before: State, after: State, h: Array, s: Array) -> tuple[Array, Array, Array]:
    """Positions, velocities and accelerations (n, 3) at the share `s` of a step's way, by Hermite's cubic."""

    def position(s: Array) -> Array:
        way, slope, end = after.x - before.x, h * before.v, h * after.v
        curve, twist = 3.0 * way - 2.0 * slope - end, slope + end - 2.0 * way
        return before.x + s * (slope + s * (curve + s * twist))

    def velocity(s: Array) -> Array:
        return jax.jvp(position, (s,), (jnp.ones_like(s),))[1] / h

    v, a = jax.jvp(velocity, (s,), (jnp.ones_like(s),))
    return position(s), v, a / h
