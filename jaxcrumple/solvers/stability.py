"""How fast a sheet vibrates at most, from element-wise bounds: what limits explicit steps."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from jaxcrumple.model.bending import stop_derivatives
from jaxcrumple.model.geometry import gather, hinge_gradient, length, outer, sub
from jaxcrumple.model.scene import Scene


class Fastest(NamedTuple):
    """Bounds in 1/s of the largest frequency `omega`, and of the decay rates that internal `damping` and
    `drag` cause."""

    omega: Array
    damping: Array
    drag: Array


def fastest(scene: Scene, x: Array, t: ArrayLike = 0.0) -> Fastest:
    """Bounds for the motion at positions `x` (n, 3) and time `t`.

    For a spring $(\\hat r\\cdot(u_i - u_j))^2 \\le 2(\\hat r\\cdot u_i)^2 + 2(\\hat r\\cdot u_j)^2$, and
    for a hinge the factor is 4, so twice (four times) the nodes' own blocks bound the spectrum; on
    the hexagonal lattice the spring bound is sharp ($6 k_s/m$). Damping enters as $\\omega^2
    b_{int}/k_s$ and $b_{iso}/m$, the largest decay rates.
    """
    omega_sq = jnp.max(largest_eigenvalue(_stiffness_bound(scene, x, t)) / scene.mass)
    damping = drag = jnp.zeros(())
    if scene.damping is not None:
        damping = omega_sq * jnp.max(scene.damping.coefficient / scene.membrane.stiffness)
    if scene.drag is not None:
        drag = jnp.max(scene.drag.coefficient / scene.mass)
    return Fastest(jnp.sqrt(omega_sq), damping, drag)


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
