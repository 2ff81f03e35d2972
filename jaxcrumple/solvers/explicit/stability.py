"""The stability limit of explicit steps: bounds of the largest frequency and decay rates of a sheet."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxcrumple._jax.arrays import Count, HingeValues, NodeValues, NodeVectors, Scalar, ScalarLike
from jaxcrumple.contact.energy import nearer_product
from jaxcrumple.scene import Scene
from jaxcrumple.state import Limit
from jaxcrumple.system import elastic_tangent

# Steps of Lanczos's method. In flat, folded and pressed sheets the bound is 6 to 12 % above the largest
# frequency.
STEPS = 8
# The norm of a matrix to the power 2^SQUARINGS gives its largest eigenvalue to 0.3 %.
SQUARINGS = 9

# Last two vectors of Lanczos's method, and the length of the last residual.
_Lanczos = tuple[Float[Array, " unknowns"], Float[Array, " unknowns"], Scalar]


class Fastest(NamedTuple):
    """Hold bounds in 1/s of the largest frequency `omega`, and of the decay rates of internal `damping` and
    `drag`."""

    omega: Scalar
    damping: Scalar
    drag: Scalar


def fastest(scene: Scene, x: NodeVectors, t: ScalarLike = 0.0, p: HingeValues | None = None) -> Fastest:
    """Bound frequency and decay rates at positions `x` (n, 3), time `t` and rest curvatures `p` (h,).

    `p` None: the rest curvatures of the undamaged sheet. The bound comes from the assembled elastic tangent,
    because bounds from its elements are 2.8 times as high in layers that press on each other. The largest
    decay rates are $\\omega^2 b_{int}/k_s$ and $b_{iso}/m$.
    """
    scene, x, p = jax.lax.stop_gradient((scene, x, p))
    own = _alone(scene)
    rows, root = (
        own.sparsity.expand(elastic_tangent(own, x, p, jnp.asarray(t))),
        jnp.repeat(scene.mass, 3) ** -0.5,
    )
    pushed = _contact_product(scene, x)

    def product(u: Float[Array, " unknowns"]) -> Float[Array, " unknowns"]:
        u = root * u
        forces = own.sparsity.expanded_product(rows, u)
        return root * (forces if pushed is None else forces + pushed(u.reshape(x.shape)).reshape(-1))

    omega_sq = largest_eigenvalue(product, x.size)
    damping = drag = jnp.zeros(())
    if scene.damping is not None:
        damping = omega_sq * jnp.max(scene.damping.coefficient / scene.membrane.stiffness)
    if scene.drag is not None:
        drag = jnp.max(scene.drag.coefficient / scene.mass)
    return Fastest(jnp.sqrt(omega_sq), damping, drag)


def _alone(scene: Scene) -> Scene:
    """Return the scene without self-contact."""
    return dataclasses.replace(scene, contact=None, lists=None)


def _contact_product(scene: Scene, x: NodeVectors) -> Callable[[NodeVectors], NodeVectors] | None:
    """Return the product with the tangent of contact, as `nearer_product` does; None without contact."""
    return None if scene.contact is None else nearer_product(scene.contact, scene.own_lists, x)


def wall_stiffness(scene: Scene, x: NodeVectors, t: ScalarLike) -> NodeValues:
    """Bound the stiffness (n,) in N/m of the walls at each node, at positions `x` (n, 3) and time `t`."""
    return sum((wall.stiffness_bound(x, jnp.asarray(t)) for wall in scene.walls), jnp.zeros(scene.n_nodes))


def beside_walls(
    scene: Scene, limit: Limit, x: NodeVectors, t: Scalar, stable: Callable[[Fastest], Scalar]
) -> Scalar:
    """Return the largest stable step in s at positions `x` (n, 3) and time `t`.

    It reduces the measured `limit` by the walls that became stiffer after its measurement; `stable` gives the
    stability limit of the method. A node that meets a wall stiffens without bound within a few steps, so
    that every step needs this check. The squared frequency grows by at most $\\omega_w^2$ if the walls become
    stiffer by $m \\omega_w^2$ (Weyl's inequality). The worst case is a step limited by dashpots, because that
    limit is inversely proportional to their decay rate. The share r of the limit that remains then solves
    $r + (\\omega_w h / z)^2 r^2 = 1$, with limit h and the stable product z of step and frequency without
    damping.
    """
    if not scene.walls:
        return limit.step
    undamped = stable(Fastest(jnp.ones(()), jnp.zeros(()), jnp.zeros(())))
    grown = jnp.maximum(wall_stiffness(scene, x, t) - limit.walls, 0.0)
    share = jnp.max(grown / scene.mass) * (limit.step / undamped) ** 2
    return limit.step * 2.0 / (1.0 + jnp.sqrt(1.0 + 4.0 * share))


def largest_eigenvalue(
    product: Callable[[Float[Array, " unknowns"]], Float[Array, " unknowns"]], size: int
) -> Scalar:
    """Bound the largest eigenvalue of a symmetric matrix, given its `product` with vectors (`size`,).

    The bound is the largest Ritz value of a few Lanczos steps from a fixed random vector, plus the norm of
    the last residual (Zhou & Li, Linear Algebra Appl. 435, 2011, 480). It is 0 if no eigenvalue is positive.
    """

    def step(carry: _Lanczos, _: None) -> tuple[_Lanczos, Float[Array, "2"]]:
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


def _largest(a: Float[Array, "rows rows"]) -> Scalar:
    """Compute the largest eigenvalue of a small symmetric matrix (k, k) from its powers, slightly too large.

    It avoids LAPACK: XLA runs a batch of such calls on its thread pool and waits there, so that two
    simultaneous calls hang a pool of two threads.
    """
    shift = jnp.max(jnp.sum(jnp.abs(a), axis=1))

    def square(k: Count, carry: tuple[Float[Array, "rows rows"], Scalar]) -> Any:
        power, logarithm = carry
        size = jnp.linalg.norm(power)
        scaled = power / jnp.where(size > 0, size, 1.0)
        return scaled @ scaled, logarithm + jnp.log(size) * 0.5**k

    start = a + shift * jnp.eye(len(a)), jnp.zeros(())
    power, logarithm = jax.lax.fori_loop(0, SQUARINGS, square, start)
    size = jnp.linalg.norm(power)
    return jnp.where(shift > 0, jnp.exp(logarithm + jnp.log(size) / 2**SQUARINGS) - shift, 0.0)
