"""Who meets whom: candidate pairs of triangles, and the pairs of sites among them, as lists that hold for a
while.

Three tiers. `Candidates` are pairs of triangles that may come within the contact range while no node moves
further than its reach. `Near`, refreshed inside a compiled program, are those that may do so while no node
moves further than its slack, which is less, with their pairs of sites; `Tight` are those of the pairs of
sites that may interact within the next step or two. Motion counts from the positions at which a list was
made, less the mean motion of the sheet, which changes no distance. Lists are ordered and what does not
interact adds exact zeros, so results do not depend on when a list was made.
"""

from collections.abc import Callable
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
# Pairs of triangles, and of sites, that are looked at together while a list is made.
PAIRS, SITES = 128, 4096
# Smallest slack of a node, in ranges, in a `Near` and in a `Tight`.
SLACK, TIGHT_SLACK = 0.25, 0.05
# Steps like the next one for which a list is made, and that step itself with some room.
SEVERAL, ONE = 3.0, 1.2


class Candidates(eqx.Module):
    """Pairs of triangles that may meet.

    `triangles` (c, 2), first below second, sorted, the first `count` of them valid; made at positions `x`
    (n, 3) m for motions up to `reach` (n,) m. `folded` (w,): which of the ways of `Fans` are among them.
    """

    triangles: Array
    count: Array
    x: Array
    reach: Array
    folded: Array

    def made_for(self, x: Array, reach: Array) -> Array:
        """Whether the list is that of positions `x` (n, 3) and `reach` (n,)."""
        return jnp.all(self.x == x) & jnp.all(self.reach == reach)

    def covers(self, x: Array, share: float = 1.0) -> Array:
        """Whether no node is further away than this share of its reach."""
        return jnp.all(motion(self.x, x) <= share * self.reach)


class Near(eqx.Module):
    """Pairs of sites that may interact.

    - `pairs` (T,): their triangles' place among the candidates; `triangles` (T, 2); `distance` (T,) m
      between the parts of the two that share no node; the first `pair_count` are valid.
    - `found` (K,): sites of the first triangle that lie near the second, as place in `triangles` * s + site.
    - `picked` (P,): pairs of sites, as place in `found` * s + site of the second triangle; the first
      `site_count` are valid.
    - `x` (n, 3), `slack` (n,): where the list was made, and how far nodes may move.
    - `needed` (3,): as `Room`, at least; the list holds nowhere where that is more than there is.
    """

    pairs: Array
    triangles: Array
    distance: Array
    pair_count: Array
    found: Array
    picked: Array
    site_count: Array
    x: Array
    slack: Array
    needed: Array

    @property
    def overflow(self) -> Array:
        """Which (3,) of the sizes were too small."""
        return self.needed > jnp.asarray(self.room)

    @property
    def room(self) -> "Room":
        """The sizes of the list."""
        return Room(self.pairs.shape[0], self.found.shape[0], self.picked.shape[0])

    def covers(self, x: Array, share: float = 1.0) -> Array:
        """Whether no node is further away than this share of its slack, and all pairs fitted."""
        return jnp.all(motion(self.x, x) <= share * self.slack) & ~jnp.any(self.overflow)


class Tight(eqx.Module):
    """Pairs of sites out of a `Near`, `picked` (P,) as there, the first `count` of them valid, while no node
    moves further than `slack` (n,) from `x` (n, 3)."""

    picked: Array
    count: Array
    x: Array
    slack: Array

    def covers(self, x: Array, share: float = 1.0) -> Array:
        """Whether no node is further away than this share of its slack."""
        return jnp.all(motion(self.x, x) <= share * self.slack)


def whole(near: Near) -> Tight:
    """All pairs of sites in a list."""
    return Tight(near.picked, near.site_count, near.x, near.slack)


class Room(NamedTuple):
    """Sizes of a `Near`: pairs of triangles, sites at triangles, pairs of sites."""

    triangles: int = 1
    sites: int = 1
    pairs: int = 1


SMALLEST = Room()


def split(place: Array, width: int) -> tuple[Array, Array]:
    """Row and column of places row * `width` + column, none negative."""
    columns = jnp.asarray(width, place.dtype)
    return jax.lax.div(place, columns), jax.lax.rem(place, columns)


def motion(start: Array, end: Array) -> Array:
    """Distance (n,) that each node moved, less the mean motion."""
    moved = end - start
    moved = moved - jnp.mean(moved, axis=0)
    return jnp.sqrt(jnp.sum(moved * moved, axis=1))


def no_candidates(n: int, ways: int, room: int = 1) -> Candidates:
    """A list that holds nowhere."""
    triangles, folded = jnp.zeros((room, 2), jnp.int32), jnp.zeros(ways, bool)
    return Candidates(triangles, jnp.zeros((), int), jnp.full((n, 3), jnp.nan, float), jnp.zeros(n), folded)


def no_neighbors(n: int, room: Room = SMALLEST) -> Near:
    """A list that holds nowhere."""
    t, zero = room.triangles, jnp.zeros((), int)
    return Near(
        jnp.zeros(t, jnp.int32), jnp.zeros((t, 2), jnp.int32), jnp.zeros(t), zero,
        jnp.zeros(room.sites, jnp.int32), jnp.zeros(room.pairs, jnp.int32), zero,
        jnp.full((n, 3), jnp.nan, float), jnp.zeros(n), jnp.zeros(3, int),
    )  # fmt: skip


def slack_for(contact: "Contact", x: Array, ahead: Array) -> Array:
    """Slack (n,) of a list made at `x` for steps that go to `ahead` (n, 3): for a few of them, or for one
    where that is far."""
    moved = motion(x, ahead)
    few = jnp.minimum(SEVERAL * moved, jnp.maximum(ONE * moved, 2.0 * SLACK * contact.range))
    return SLACK * contact.range + few


def find_near(contact: "Contact", x: Array, slack: Array) -> Near:
    """The pairs of sites that may interact while no node moves further than `slack` (n,) from `x` (n, 3),
    in a list of the same size as the one that `contact` has."""
    candidates, faces, room = contact.candidates, contact.faces, contact.near.room
    first, second = faces[candidates.triangles[:, 0]], faces[candidates.triangles[:, 1]]
    reach = contact.range + jnp.max(slack[first], axis=1) + jnp.max(slack[second], axis=1)

    def close(at: Array) -> Array:
        return (_distances(x, first[at], second[at])[0] <= reach[at])[:, None]

    pairs, pair_count = compacted(close, candidates.count, 1, room.triangles, PAIRS)
    first, second, reach = first[pairs], second[pairs], reach[pairs]

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
        pairs=pairs,
        triangles=candidates.triangles[pairs],
        distance=_fill(lambda at: _distances(x, first[at], second[at])[1], pair_count, room.triangles),
        pair_count=pair_count,
        found=found,
        picked=picked,
        site_count=total,
        x=x,
        slack=slack,
        needed=jnp.stack([pair_count, found_count, total]),
    )


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
