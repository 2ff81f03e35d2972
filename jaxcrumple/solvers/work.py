"""The work ledger: the work of walls and supports on a sheet, its storage and its dissipation, step by step.

Within an accepted step of any stage, positions follow the cubic Hermite interpolant of the positions and
velocities at both ends. Along that path the sheet obeys the equations of motion up to a residual force
$r = M\\ddot x - F$, so that

$$\\Delta E = W_{walls} + W_{supports} + W_{drag} + W_{damping} + W_{plastic} + W_{numerical},$$

with the numerical work $W_{numerical} = \\int r\\cdot\\dot x\\,dt$. It contains the dissipation of the
method, and the terms that the quasistatic stage and changes of stage neglect. Two-point Gauss quadrature
integrates all terms. The energies do not depend on the path, so that their balance checks the ledger.
"""

import jax
import jax.numpy as jnp

from jaxcrumple._jax.arrays import HingeValues, NodeVectors, Scalar
from jaxcrumple.scene import Scene
from jaxcrumple.state import State, Work
from jaxcrumple.system import energies, force

# Gauss points on (0, 1), each of weight one half.
POINTS = (0.5 - 0.5 / 3.0**0.5, 0.5 + 0.5 / 3.0**0.5)


def booked(scene: Scene, before: State, after: State, h: Scalar) -> Work:
    """Return the ledger after an accepted step of `h` s between two states."""
    assert before.work is not None

    def at(share: Scalar) -> Work:
        return _power(scene, before, after, h, share)

    powers = jax.lax.map(at, jnp.asarray(POINTS))
    return jax.tree.map(lambda old, power: old + h * jnp.mean(power), before.work, powers)


def _power(scene: Scene, before: State, after: State, h: Scalar, s: Scalar) -> Work:
    """Compute the power in W of each source of work, at the fraction `s` of a step."""
    x, v, a = _path(before, after, h, s)
    t = before.t + s * h
    p, flow = before.p, None
    if before.p is not None and after.p is not None:
        p, flow = before.p + s * (after.p - before.p), (after.p - before.p) / h
    rest = scene.mass[:, None] * a - force(scene, x, v, p, t)
    free = rest if scene.prescribed is None else scene.prescribed.free(rest, t)
    zero = jnp.zeros(())

    def stored(t: Scalar, p: HingeValues | None) -> Scalar:
        parts = energies(scene, x, v, p, t)
        return parts.walls + parts.extra + parts.bending

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


def _path(before: State, after: State, h: Scalar, s: Scalar) -> tuple[NodeVectors, NodeVectors, NodeVectors]:
    """Return positions, velocities and accelerations (n, 3) of the Hermite cubic at the fraction `s`."""

    def position(s: Scalar) -> NodeVectors:
        way, slope, end = after.x - before.x, h * before.v, h * after.v
        curve, twist = 3.0 * way - 2.0 * slope - end, slope + end - 2.0 * way
        return before.x + s * (slope + s * (curve + s * twist))

    def velocity(s: Scalar) -> NodeVectors:
        return jax.jvp(position, (s,), (jnp.ones_like(s),))[1] / h

    v, a = jax.jvp(velocity, (s,), (jnp.ones_like(s),))
    return position(s), v, a / h
