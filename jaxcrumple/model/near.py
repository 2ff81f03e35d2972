"""Who meets whom: candidate pairs of triangles, and the pairs of sites among them, as lists that hold for a
while.

Two tiers. `Candidates` are pairs of triangles that may come within the contact range while no node moves
further than its reach, which is that of many steps. `Near` are those that may do so within a step or two,
with their pairs of sites. Motion counts from the positions at which a list was made, less the mean motion of
the sheet, which changes no distance. Lists are ordered and what does not interact adds exact zeros, so
results do not depend on when a list was made.
"""

from collections.abc import Callable
from functools import reduce
from typing import TYPE_CHECKING, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from jaxcrumple.model.chunks import compacted
from jaxcrumple.model.distance import TINY, primitive_distances, shared_parts
from jaxcrumple.model.geometry import Vec, cross, dot, gather, scale, sub

if TYPE_CHECKING:
    from jaxcrumple.model.contact import Contact

# Sites that are nearer than this many ranges in the rest state never interact.
EXCLUSION = 2.0
# Pairs of boxes, of triangles and of sites that are looked at together while a list is made.
BOXES, PAIRS, SITES = 1024, 128, 4096
# Behind the keys of all pairs of triangles.
NONE = jnp.iinfo(jnp.int64).max


class Around(eqx.Module):
    """What a list is made for: motions up to `reach` (n,) m from positions `x` (n, 3) m."""

    x: Array
    reach: Array

    def equals(self, other: "Around") -> Array:
        """Whether the other one is the same."""
        return jnp.all(self.x == other.x) & jnp.all(self.reach == other.reach)

    def covers(self, x: Array, spare: Array | float = 0.0) -> Array:
        """Whether each node of `x` (n, 3) may go `spare` m further before it leaves its reach."""
        return jnp.all(motion(self.x, x) + spare <= self.reach)


class Candidates(eqx.Module):
    """Pairs of triangles that may meet.

    `triangles` (c, 2), first below second, sorted, the first `count` of them valid, for motions `around`.
    `folded` (w,): which of the ways of `Fans` are among them.
    """

    triangles: Array
    count: Array
    around: Around
    folded: Array


class Near(eqx.Module):
    """Pairs of sites that may interact.

    - `triangles` (T, 2), and `distance` (T,) m between the parts of the two that share no node; the first
      `pair_count` are valid.
    - `found` (K,): sites of the first triangle that lie near the second, as place in `triangles` * s + site.
    - `picked` (P,): pairs of sites, as place in `found` * s + site of the second triangle; the first
      `site_count` are valid.
    - `around`: the motions for which it holds.
    - `needed` (3,): as `Room`, at least; the list holds nowhere where that is more than there is.
    """

    triangles: Array
    distance: Array
    pair_count: Array
    found: Array
    picked: Array
    site_count: Array
    around: Around
    needed: Array

    @property
    def overflow(self) -> Array:
        """Which (3,) of the sizes were too small."""
        return self.needed > jnp.asarray(self.room)

    @property
    def room(self) -> "Room":
        """The sizes of the list."""
        return Room(self.triangles.shape[0], self.found.shape[0], self.picked.shape[0])

    def covers(self, x: Array, spare: Array | float = 0.0) -> Array:
        """Whether each node may go `spare` m further before it leaves its reach, and all pairs fitted."""
        return self.around.covers(x, spare) & ~jnp.any(self.overflow)


class Room(NamedTuple):
    """Sizes of a `Near`: pairs of triangles, sites at triangles, pairs of sites."""

    triangles: int = 1
    sites: int = 1
    pairs: int = 1


SMALLEST = Room()


def pair_key(triangles: Array, n_faces: int) -> Array:
    """Keys (m,) of pairs of triangles (m, 2), first below second, in the order of sorted pairs."""
    wide = triangles.astype(jnp.int64)
    return wide[:, 0] * n_faces + wide[:, 1]


def split(place: Array, width: int) -> tuple[Array, Array]:
    """Row and column of places row * `width` + column, none negative."""
    columns = jnp.asarray(width, place.dtype)
    return jax.lax.div(place, columns), jax.lax.rem(place, columns)


def motion(start: Array, end: Array) -> Array:
    """Distance (n,) that each node moved, less the mean motion."""
    moved = end - start
    moved = moved - jnp.mean(moved, axis=0)
    return jnp.sqrt(jnp.sum(moved * moved, axis=1))


def nowhere(n: int) -> Around:
    """No motions at all."""
    return Around(jnp.full((n, 3), jnp.nan, float), jnp.zeros(n))


def no_candidates(n: int, ways: int, room: int = 1) -> Candidates:
    """A list that holds nowhere."""
    triangles, folded = jnp.zeros((room, 2), jnp.int32), jnp.zeros(ways, bool)
    return Candidates(triangles, jnp.zeros((), int), nowhere(n), folded)


def no_neighbors(n: int, room: Room = SMALLEST) -> Near:
    """A list that holds nowhere."""
    t, zero = room.triangles, jnp.zeros((), int)
    return Near(
        jnp.zeros((t, 2), jnp.int32), jnp.zeros(t), zero, jnp.zeros(room.sites, jnp.int32),
        jnp.zeros(room.pairs, jnp.int32), zero, nowhere(n), jnp.zeros(3, int),
    )  # fmt: skip


def find_near(contact: "Contact", around: Around) -> Near:
    """The pairs of sites that may interact within motions `around`, in a list of the same size as the one
    that `contact` has."""
    faces, room, x = contact.faces, contact.near.room, around.x
    triangles, pair_count = _near_triangles(contact, around)
    first, second = faces[triangles[:, 0]], faces[triangles[:, 1]]
    reach = _limit(contact, around, first, second)

    def site_close(at: Array) -> Array:
        """Sites of the first triangles that lie near the second ones."""
        return _around(contact.weights, gather(x, first[at]), gather(x, second[at]), reach[at])

    count = contact.weights.shape[0]
    rows = max(SITES // count, 1)
    found, found_count = compacted(site_close, pair_count, count, room.sites, rows)
    owner, site = split(found, count)

    def sites_close(at: Array) -> Array:
        """Sites of the second triangles near a site of the first, whose neighbours at rest they were not."""
        one, two, limit = first[owner[at]], second[owner[at]], reach[owner[at]]
        weights = contact.weights[site[at]]
        near = _squared(contact.weights, x, one, weights, two) <= (limit * limit)[:, None]
        apart = _squared(contact.weights, contact.rest, one, weights, two)
        return near & (apart >= (EXCLUSION * contact.range) ** 2)

    picked, total = compacted(sites_close, found_count, count, room.pairs, rows)
    return Near(
        triangles=triangles,
        distance=_fill(lambda at: _distances(x, first[at], second[at])[1], pair_count, room.triangles),
        pair_count=pair_count,
        found=found,
        picked=picked,
        site_count=total,
        around=around,
        needed=jnp.stack([pair_count, found_count, total]),
    )


def _near_triangles(contact: "Contact", around: Around) -> tuple[Array, Array]:
    """Pairs of triangles (T, 2) that may come within the range, and how many they are."""
    candidates, faces = contact.candidates, contact.faces
    low, high = boxes(around.x[faces], jnp.max(around.reach[faces], axis=1))

    def overlap(at: Array) -> Array:
        one, two = candidates.triangles[at, 0], candidates.triangles[at, 1]
        return boxes_meet(low, high, one, two, contact.range)[:, None]

    size = candidates.triangles.shape[0]
    rough, count = compacted(overlap, candidates.count, 1, size, BOXES)

    def close(at: Array) -> Array:
        first, second = (faces[candidates.triangles[rough[at], side]] for side in range(2))
        return (_distances(around.x, first, second)[0] <= _limit(contact, around, first, second))[:, None]

    kept, pair_count = compacted(close, count, 1, contact.near.room.triangles, PAIRS, lambda at: rough[at])
    return candidates.triangles[kept], pair_count


def _limit(contact: "Contact", around: Around, first: Array, second: Array) -> Array:
    """Distance (m,) within which pairs of triangles with nodes (m, 3) may interact."""
    return contact.range + sum(jnp.max(around.reach[nodes], axis=1) for nodes in (first, second))


def boxes(corners: Array, extent: Array) -> tuple[Vec, Vec]:
    """Lowest and highest coordinates, three (f,) each, of triangles with `corners` (f, 3, 3) that move by
    `extent` (f,)."""
    low, high = jnp.min(corners, axis=1) - extent[:, None], jnp.max(corners, axis=1) + extent[:, None]
    return (low[:, 0], low[:, 1], low[:, 2]), (high[:, 0], high[:, 1], high[:, 2])


def boxes_meet(low: Vec, high: Vec, one: Array, two: Array, range: Array) -> Array:
    """Whether the boxes `one` (m,) and `two` (m,) come within the range of one another."""
    apart = [jnp.maximum(a[one] - b[two], a[two] - b[one]) for a, b in zip(low, high, strict=True)]
    return reduce(jnp.maximum, apart) <= range


def _distances(x: Array, first: Array, second: Array) -> tuple[Array, Array]:
    """Distance (m,) of triangles with nodes (m, 3), and of those of their parts that share no node."""
    parts = primitive_distances(gather(x, first), gather(x, second))
    shared = shared_parts(first, second)
    whole = jnp.where(jnp.any(shared, axis=0), 0.0, jnp.sqrt(jnp.min(parts, axis=0)))
    return whole, jnp.sqrt(jnp.min(jnp.where(shared, jnp.inf, parts), axis=0))


def _fill(value: Callable[[Array], Array], count: Array, size: int) -> Array:
    """The first `count` of `size` numbers, a few at a time; the others are 0."""

    def body(carry):
        chunk, values = carry
        at = jnp.minimum(chunk * PAIRS + jnp.arange(PAIRS), size - 1)
        return chunk + 1, jax.lax.dynamic_update_slice(values, value(at), (chunk * PAIRS,))

    start = (jnp.asarray(0), jnp.zeros(size + PAIRS))
    return jax.lax.while_loop(lambda c: c[0] * PAIRS < jnp.minimum(count, size), body, start)[1][:size]


def _around(weights: Array, first: tuple[Vec, ...], second: tuple[Vec, ...], reach: Array) -> Array:
    """Which sites (m, s) of the first triangles lie within a prism around the second ones, `reach` (m,) wide.

    The prism's five sides are planes, and a site's height above a plane is the mean of its corners' heights.
    """
    edges = [sub(second[(k + 1) % 3], second[k]) for k in range(3)]
    normal = _unit(cross(edges[0], edges[1]))
    inside = jnp.ones((reach.shape[0], weights.shape[0]), bool)
    for corner, direction in [
        (second[0], normal),
        (second[0], scale(-1.0, normal)),
        *((second[k], _unit(cross(edges[k], normal))) for k in range(3)),
    ]:
        heights = jnp.stack([dot(sub(c, corner), direction) for c in first], axis=1)
        inside = inside & (heights @ weights.T <= reach[:, None])
    return inside


def _unit(a: Vec) -> Vec:
    return scale(1.0 / jnp.sqrt(dot(a, a) + TINY), a)


def _squared(lattice: Array, x: Array, one: Array, weights: Array, two: Array) -> Array:
    """Squared distances (m, s) of a site with `weights` (m, 3) in the triangle `one` (m, 3) from all sites of
    `two`.

    They are quadratic in a site's two coordinates: a product of matrices.
    """
    corner, second, third = (x[two[:, k]] for k in (2, 0, 1))
    point = jnp.einsum("mk,mki->mi", weights, x[one]) - corner
    u, v = second - corner, third - corner

    def pair(a: Array, b: Array) -> Array:
        return jnp.sum(a * b, axis=1)

    form = jnp.stack(
        [
            pair(point, point), -2.0 * pair(point, u), -2.0 * pair(point, v), pair(u, u), 2.0 * pair(u, v),
            pair(v, v),
        ],
        axis=1,
    )  # fmt: skip
    a, b = lattice[:, 0], lattice[:, 1]
    return form @ jnp.stack([jnp.ones_like(a), a, b, a * a, a * b, b * b])
