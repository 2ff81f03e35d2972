"""Continuous collision detection by conservative advancement.

Zhang et al., ACM TOG 25, 2006; Li et al., 2021.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Shaped

from jaxcrumple._jax.arrays import Count, Flag, NodeVectors, Scalar
from jaxcrumple._jax.padded import accumulate
from jaxcrumple.contact.active_set import may_touch
from jaxcrumple.contact.lists import ContactLists, motion
from jaxcrumple.contact.parameters import Contact
from jaxcrumple.geometry.distance import paired_corners, primitive_distances, shared_parts

# Parts of the sheet count as touching when their distance falls to this share of its start value, or of the
# range if that is less. An advance leaves at least half of this distance.
TOUCHING = 0.1
# A pair that does not reach the end of the step within this many advances counts as touching.
ADVANCES = 64
# Pairs of triangles per chunk.
DOUBTED = 64


def crosses(contact: Contact, lists: ContactLists, start: NodeVectors, end: NodeVectors) -> Flag:
    """Return whether parts of the sheet might touch while nodes move straight from `start` to `end` (n, 3).

    The test is conservative: it misses no contact, but may report one that does not occur. The lists must be
    valid for both positions. For two triangles that share a node, it tests the parts that do not share it.
    """
    if lists.active is not None:
        return _pairs_cross(contact, lists, start, end)
    pairs = lists.pairs
    listed = jnp.arange(pairs.distance.shape[0]) < pairs.triangle_count
    nearest = jnp.min(jnp.where(listed, pairs.distance, jnp.inf))
    furthest = jnp.max(jnp.maximum(*(motion(pairs.reference.x, x) for x in (start, end))))
    # This global bound usually suffices.
    return jax.lax.cond(
        2.0 * furthest < nearest,
        lambda: jnp.asarray(False),
        lambda: _pairs_cross(contact, lists, start, end),
    )


def _pairs_cross(contact: Contact, lists: ContactLists, start: NodeVectors, end: NodeVectors) -> Flag:
    """Return the same as `crosses`, from a test of each pair that may touch."""
    pairs = lists.pairs
    places, count = may_touch(contact, lists, start, end)
    moves = jnp.maximum(*(motion(pairs.reference.x, x) for x in (start, end)))
    both = jnp.concatenate([start, end - start], axis=1)

    def add(
        touched: Flag,
        arguments: tuple[Shaped[Array, "..."], ...],
        at: Int[Array, " chunk"],
        held: Bool[Array, " chunk"],
    ) -> Flag:
        both, moves, distance, triangles, faces, places = arguments
        at = places[at]
        first, second = (faces[triangles[at, side]] for side in range(2))
        # An active set also covers other motions. Pairs that this step cannot bring together must not decide.
        nearer = jnp.max(moves[first], axis=1) + jnp.max(moves[second], axis=1)
        asked = held & (distance[at] <= nearer)
        corners, steps = jnp.split(paired_corners(both, first, second), 2, axis=2)
        return touched | jnp.any(touches(corners, steps, shared_parts(first, second), contact.range, asked))

    arguments = both, moves, pairs.distance, pairs.triangles, contact.faces, places
    return accumulate(add, jnp.asarray(False), arguments, count, pairs.capacity.triangles, DOUBTED)


Corners = Float[Array, "2 3 3 pairs"]
_Advance = tuple[Float[Array, " pairs"], Float[Array, " pairs"], Bool[Array, " pairs"], Count]


def touches(
    corners: Corners,
    steps: Corners,
    shared: Bool[Array, "15 pairs"],
    range: Scalar | float,
    asked: Bool[Array, " pairs"],
) -> Bool[Array, " pairs"]:
    """Return which (m,) of the pairs of triangles flagged in `asked` (m,) might touch along `steps`.

    `corners`, `steps` (2, 3, 3, m): corners of both triangles in m, as in `paired_corners`, and their
    displacements; `shared` (15, m): parts to ignore, as in `shared_parts`; `range`: contact range in m, which
    limits the distance at which parts count as touching.
    """

    def distance(t: Float[Array, " pairs"]) -> Float[Array, " pairs"]:
        parts = primitive_distances(corners + t * steps)
        return jnp.sqrt(jnp.min(jnp.where(shared, jnp.inf, parts), axis=0))

    speed = jnp.maximum(_relative_motion(steps), 1e-300)

    def body(carry: _Advance) -> _Advance:
        t, floor, touched, count = carry
        gap = distance(t)
        floor = jnp.where(count == 0, TOUCHING * jnp.minimum(gap, range), floor)
        touched = touched | (asked & (t < 1.0) & (gap <= floor))
        # No part comes closer than half of the floor before the next evaluation.
        ahead = jnp.where(touched | ~asked, 1.0, t + (gap - 0.5 * floor) / speed)
        return jnp.minimum(ahead, 1.0), floor, touched, count + 1

    def unfinished(carry: _Advance) -> Flag:
        t, _, _, count = carry
        return jnp.any(t < 1.0) & (count < ADVANCES)

    zero = jnp.zeros_like(speed)
    t, _, touched, _ = jax.lax.while_loop(
        unfinished, body, (zero, zero, jnp.zeros_like(asked), jnp.asarray(0))
    )
    return touched | (asked & (t < 1.0))


def _relative_motion(steps: Corners) -> Float[Array, " pairs"]:
    """Return a bound (m,) in m on the approach of two triangles along a step, without their common motion."""
    own = steps - jnp.mean(steps, axis=(0, 1))
    lengths = jnp.sqrt(jnp.sum(own**2, axis=2))
    return jnp.sum(jnp.max(lengths, axis=1), axis=0)
