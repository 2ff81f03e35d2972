"""How fast a sheet vibrates at most: what limits explicit steps."""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from jaxcrumple.scene import Scene
from jaxcrumple.state import Limit
from jaxcrumple.system import elastic_tangent

# Steps of Lanczos's method: in flat, folded and pressed sheets their bound is 6 to 12 % above the largest
# frequency.
STEPS = 8
# A power of two by which the norm of a matrix to that power is its largest eigenvalue within 0.3 %.
SQUARINGS = 9


class Fastest(NamedTuple):
    """Bounds in 1/s of the largest frequency `omega`, and of the decay rates that internal `damping` and
    `drag` cause."""

    omega: Array
    damping: Array
    drag: Array


def fastest(scene: Scene, x: Array, t: ArrayLike = 0.0, p: Array | None = None) -> Fastest:
    """Bounds for the motion at positions `x` (n, 3), time `t` and rest curvatures `p` (h,), by default those
    without damage.

    Those of the elastic tangent itself: bounds from its elements are 2.8 times as high where layers press one
    another. Damping enters as $\\omega^2 b_{int}/k_s$ and $b_{iso}/m$, the largest decay rates.
    """
    scene, x, p = jax.lax.stop_gradient((scene, x, p))
    own = _alone(scene)
    rows, root = (
        own.pattern.expand(elastic_tangent(own, x, p, jnp.asarray(t))),
        jnp.repeat(scene.mass, 3) ** -0.5,
    )
    pushed = None if scene.contact is None else scene.contact.nearer_product(x)

    def product(u: Array) -> Array:
        u = root * u
        forces = own.pattern.expanded_product(rows, u)
        return root * (forces if pushed is None else forces + pushed(u.reshape(x.shape)).reshape(-1))

    omega_sq = largest_eigenvalue(product, x.size)
    damping = drag = jnp.zeros(())
    if scene.damping is not None:
        damping = omega_sq * jnp.max(scene.damping.coefficient / scene.membrane.stiffness)
    if scene.drag is not None:
        drag = jnp.max(scene.drag.coefficient / scene.mass)
    return Fastest(jnp.sqrt(omega_sq), damping, drag)


def _alone(scene: Scene) -> Scene:
    """The sheet without self-contact."""
    return eqx.tree_at(
        lambda s: (s.contact, s.pattern.contact), scene, (None, None), is_leaf=lambda leaf: leaf is None
    )


def wall_stiffness(scene: Scene, x: Array, t: ArrayLike) -> Array:
    """Largest stiffness (n,) in N/m by which walls hold each node at positions `x` (n, 3) and time `t`."""
    return sum((wall.stiffness_bound(x, jnp.asarray(t)) for wall in scene.walls), jnp.zeros(scene.n_nodes))


def beside_walls(scene: Scene, limit: Limit, x: Array, t: Array, stable: Callable[[Fastest], Array]) -> Array:
    """The largest stable step in s at positions `x` (n, 3) and time `t`, not long after the `limit` of a
    method, which tells what is `stable`, was measured.

    A node that meets a wall stiffens without bound within few steps, so that this is looked at in each.
    Squares of frequencies add up at most (Weyl's inequality); dashpots, by which the limit falls with their
    rate itself, leave the least: a share r with $r + (\\omega_w h / z)^2 r^2 = 1$, where h is the limit, z
    the product of step and frequency that is stable without damping, and the walls became stiffer by
    $m \\omega_w^2$.
    """
    if not scene.walls:
        return limit.step
    undamped = stable(Fastest(jnp.ones(()), jnp.zeros(()), jnp.zeros(())))
    grown = jnp.maximum(wall_stiffness(scene, x, t) - limit.walls, 0.0)
    share = jnp.max(grown / scene.mass) * (limit.step / undamped) ** 2
    return limit.step * 2.0 / (1.0 + jnp.sqrt(1.0 + 4.0 * share))


def largest_eigenvalue(product: Callable[[Array], Array], size: int) -> Array:
    """Bound of the largest eigenvalue, or 0 where none is positive, of a symmetric matrix that a `product`
    with vectors (`size`,) stands for.

    The largest one in the space of a few steps of Lanczos's method from a random vector, always the same,
    and the norm of what the last step leaves (Zhou & Li, Linear Algebra Appl. 435, 2011, 480).
    """

    def step(carry: tuple[Array, Array, Array], _: None) -> tuple[tuple[Array, Array, Array], Array]:
        before, u, length = carry
        image = product(u) - length * before
        along = u @ image
        image = image - along * u
        length = jnp.linalg.norm(image)
        return (u, image / jnp.where(length > 0, length, 1.0), length), jnp.stack([along, length])

    start = jax.random.normal(jax.random.key(0), (size,))
    first = jnp.zeros(size), start / jnp.linalg.norm(start), jnp.zeros(())
    along, length = jax.lax.scan(step, first, None, length=STEPS)[1].T
    inner = jnp.diag(along) + jnp.diag(length[:-1], 1) + jnp.diag(length[:-1], -1)
    return jnp.maximum(_largest(inner) + length[-1], 0.0)


def _largest(a: Array) -> Array:
    """Largest eigenvalue of a small symmetric matrix (k, k), or little above, from its powers.

    Not by LAPACK: XLA runs a batch of such calls on its thread pool and waits there, so that two of them
    at once hang a pool of two threads.
    """
    shift = jnp.max(jnp.sum(jnp.abs(a), axis=1))
    power, logarithm = a + shift * jnp.eye(len(a)), jnp.zeros(())
    for k in range(SQUARINGS):
        size = jnp.linalg.norm(power)
        scaled = power / jnp.where(size > 0, size, 1.0)
        power, logarithm = scaled @ scaled, logarithm + jnp.log(size) / 2**k
    size = jnp.linalg.norm(power)
    return jnp.where(shift > 0, jnp.exp(logarithm + jnp.log(size) / 2**SQUARINGS) - shift, 0.0)
