"""No tunnelling: conservative advancement along a step (Zhang et al., ACM TOG 25, 2006; Li et al., 2021)."""

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
from jax import Array

from jaxcrumple._jax.padded import accumulate
from jaxcrumple.contact.active_set import may_touch
from jaxcrumple.contact.lists import motion
from jaxcrumple.geometry.distance import primitive_distances, shared_parts
from jaxcrumple.geometry.hinge import Vec, add, dot, gather, scale, sub

if TYPE_CHECKING:
    from jaxcrumple.contact.energy import Contact

# Share of their distance (or of the range, if that is less) at which parts of the sheet count as touching; an
# advance stops at half of it.
TOUCHING = 0.1
# Advances after which a pair that is still under way counts as touching.
ADVANCES = 64
# Pairs of triangles that are looked at together.
DOUBTED = 64


def crosses(contact: "Contact", start: Array, end: Array) -> Array:
    """Whether parts of the sheet might touch while nodes go straight from `start` to `end` (n, 3).

    Never wrong where they do; the lists must hold for both. Of two triangles that share a node, the parts
    that do not are looked at.
    """
    near = contact.near
    if contact.active is not None:
        return _pairs_cross(contact, start, end)
    listed = jnp.arange(near.distance.shape[0]) < near.pair_count
    nearest = jnp.min(jnp.where(listed, near.distance, jnp.inf))
    furthest = jnp.max(jnp.maximum(*(motion(near.around.x, x) for x in (start, end))))
    # Mostly that tells.
    return jax.lax.cond(
        2.0 * furthest < nearest, lambda: jnp.asarray(False), lambda: _pairs_cross(contact, start, end)
    )


def _pairs_cross(contact: "Contact", start: Array, end: Array) -> Array:
    """The same, by a look at the pairs that may touch."""
    near = contact.near
    places, count = may_touch(contact, start, end)
    moves = jnp.maximum(*(motion(near.around.x, x) for x in (start, end)))

    def add(touched: Array, arguments: tuple[Array, ...], at: Array, held: Array) -> Array:
        start, way, moves, distance, triangles, faces, places = arguments
        at = places[at]
        first, second = (faces[triangles[at, side]] for side in range(2))
        # Those of a list for other motions too must not tell.
        nearer = jnp.max(moves[first], axis=1) + jnp.max(moves[second], axis=1)
        asked = held & (distance[at] <= nearer)
        parts, steps = ((gather(x, first), gather(x, second)) for x in (start, way))
        return touched | jnp.any(touches(parts, steps, shared_parts(first, second), contact.range, asked))

    arguments = start, end - start, moves, near.distance, near.triangles, contact.faces, places
    return accumulate(add, jnp.asarray(False), arguments, count, near.room.triangles, DOUBTED)


Corners = tuple[tuple[Vec, ...], tuple[Vec, ...]]


def touches(corners: Corners, steps: Corners, shared: Array, range: Array, asked: Array) -> Array:
    """Which (m,) of the pairs of triangles that are `asked` about might touch along `steps`.

    `corners`, `steps`: three corners of the first and of the second triangle, and how they move; `shared`
    (15, m): parts that do not count; `range`: distance in m above which nobody needs to stay apart.
    """

    def distance(t: Array) -> Array:
        here = tuple(
            tuple(add(p, scale(t, d)) for p, d in zip(points, moves, strict=True))
            for points, moves in zip(corners, steps, strict=True)
        )
        return jnp.sqrt(jnp.min(jnp.where(shared, jnp.inf, primitive_distances(*here)), axis=0))

    speed = jnp.maximum(_relative_motion(steps), 1e-300)

    def body(carry):
        t, floor, touched, count = carry
        gap = distance(t)
        floor = jnp.where(count == 0, TOUCHING * jnp.minimum(gap, range), floor)
        touched = touched | (asked & (t < 1.0) & (gap <= floor))
        # No part comes nearer than half of the floor on the way to the next look.
        ahead = jnp.where(touched | ~asked, 1.0, t + (gap - 0.5 * floor) / speed)
        return jnp.minimum(ahead, 1.0), floor, touched, count + 1

    def unfinished(carry) -> Array:
        t, _, _, count = carry
        return jnp.any(t < 1.0) & (count < ADVANCES)

    zero = jnp.zeros_like(speed)
    t, _, touched, _ = jax.lax.while_loop(
        unfinished, body, (zero, zero, jnp.zeros_like(asked), jnp.asarray(0))
    )
    return touched | (asked & (t < 1.0))


def _relative_motion(steps: Corners) -> Array:
    """How far (m,) the parts of two triangles can come closer in all, their common motion left out."""
    everything = [*steps[0], *steps[1]]
    mean = scale(1.0 / len(everything), _sum(everything))
    lengths = [jnp.stack([jnp.sqrt(dot(r, r)) for r in (sub(d, mean) for d in side)]) for side in steps]
    return jnp.max(lengths[0], axis=0) + jnp.max(lengths[1], axis=0)


def _sum(vectors: list[Vec]) -> Vec:
    total = vectors[0]
    for vector in vectors[1:]:
        total = add(total, vector)
    return total
