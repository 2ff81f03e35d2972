"""Who meets whom: candidate pairs of triangles, and the pairs of sites among them, as lists that hold for a while.

Two tiers. `Candidates` are pairs of triangles that may come within the contact range while no node moves further
than its reach. `Near`, refreshed inside a compiled program, are those that may do so while no node moves
further than its slack, which is less, with their pairs of sites. Motion counts from the positions at which a list
was made, less the mean motion of the sheet, which changes no distance. Lists are ordered and what does
not interact adds exact zeros, so results do not depend on when a list was made.
"""

from typing import TYPE_CHECKING, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jax import Array

from jaxcrumple.model.distance import point_triangle, primitive_distances, shared_parts
from jaxcrumple.model.geometry import Vec, dot, gather, sub

if TYPE_CHECKING:
    from jaxcrumple.model.contact import Contact

# Sites that are nearer than this many ranges in the rest state never interact.
EXCLUSION = 2.0
# Smallest slack of a node, in ranges.
SLACK = 0.25


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

    def covers(self, x: Array) -> Array:
        """Whether no node is further away than its reach."""
        return jnp.all(motion(self.x, x) <= self.reach)


class Near(eqx.Module):
    """Pairs of sites that may interact.

    - `pairs` (T,): their triangles' place among the candidates; `triangles` (T, 2); `distance` (T,) m
      between the parts of the two that share no node; the first `pair_count` are valid.
    - `nodes` (P, 6), `weights` (P, 6): corners of the two triangles and what they weigh in $r_{12}$;
      `strength` (P,): area of the one site times area of the other, over $a_0^2$, 0 beyond the
      `site_count` valid ones; `owner` (P,): place in `triangles`.
    - `x` (n, 3), `slack` (n,): where the list was made, and how far nodes may move.
    - `overflow` (3,): whether pairs of triangles, sites at a triangle, or pairs of sites did not fit.
    """

    pairs: Array
    triangles: Array
    distance: Array
    pair_count: Array
    nodes: Array
    weights: Array
    strength: Array
    owner: Array
    site_count: Array
    x: Array
    slack: Array
    overflow: Array
    site_room: int = eqx.field(static=True)

    @property
    def room(self) -> "Room":
        """The sizes of the list."""
        return Room(self.pairs.shape[0], self.site_room, self.strength.shape[0])

    def covers(self, x: Array) -> Array:
        """Whether no node is further away than its slack, and all pairs fitted."""
        return jnp.all(motion(self.x, x) <= self.slack) & ~jnp.any(self.overflow)


class Room(NamedTuple):
    """Sizes of a `Near`: pairs of triangles, sites at triangles, pairs of sites."""

    triangles: int = 1
    sites: int = 1
    pairs: int = 1


def motion(start: Array, end: Array) -> Array:
    """Distance (n,) that each node moved, less the mean motion."""
    moved = end - start
    moved = moved - jnp.mean(moved, axis=0)
    return jnp.sqrt(jnp.sum(moved * moved, axis=1))


def no_candidates(n: int, ways: int) -> Candidates:
    """A list that holds nowhere."""
    triangles, folded = jnp.zeros((1, 2), jnp.int32), jnp.zeros(ways, bool)
    return Candidates(triangles, jnp.asarray(0), jnp.full((n, 3), jnp.nan), jnp.zeros(n), folded)


def no_neighbors(n: int, room: Room = Room()) -> Near:
    """A list that holds nowhere."""
    t, p, zero = room.triangles, room.pairs, jnp.asarray(0)
    return Near(
        jnp.zeros(t, jnp.int32), jnp.zeros((t, 2), jnp.int32), jnp.zeros(t), zero,
        jnp.zeros((p, 6), jnp.int32), jnp.zeros((p, 6)), jnp.zeros(p), jnp.zeros(p, jnp.int32), zero,
        jnp.full((n, 3), jnp.nan), jnp.zeros(n), jnp.zeros(3, bool), room.sites,
    )  # fmt: skip


def slack_for(contact: "Contact", x: Array, ahead: Array) -> Array:
    """Slack (n,) of a list made at `x` for steps that go to `ahead` (n, 3)."""
    return SLACK * contact.range + 1.2 * motion(x, ahead)


def find_near(contact: "Contact", x: Array, slack: Array) -> Near:
    """The pairs of sites that may interact while no node moves further than `slack` (n,) from `x` (n, 3),
    in a list of the same size as the one that `contact` has."""
    candidates, faces, sizes = contact.candidates, contact.faces, contact.near.room
    first, second = faces[candidates.triangles[:, 0]], faces[candidates.triangles[:, 1]]
    parts = primitive_distances(gather(x, first), gather(x, second))
    shared = shared_parts(first, second)
    whole = jnp.where(jnp.any(shared, axis=0), 0.0, jnp.sqrt(jnp.min(parts, axis=0)))
    apart = jnp.sqrt(jnp.min(jnp.where(shared, jnp.inf, parts), axis=0))
    room = jnp.max(slack[first], axis=1) + jnp.max(slack[second], axis=1)
    valid = jnp.arange(first.shape[0]) < candidates.count
    pairs, pair_count = _compact(valid & (whole <= contact.range + room), sizes.triangles)
    held = jnp.arange(sizes.triangles) < pair_count
    sites, site_count = _sites_at_triangles(contact, x, first[pairs], second[pairs], room[pairs], held, sizes)
    return _site_pairs(
        contact, x, slack, (pairs, pair_count), candidates.triangles[pairs], apart[pairs], room[pairs],
        (sites, site_count), sizes,
    )  # fmt: skip


def _compact(mask: Array, size: int) -> tuple[Array, Array]:
    """Places of the first `size` true entries, 0 beyond, and how many there are in all."""
    return jnp.nonzero(mask, size=size, fill_value=0)[0].astype(jnp.int32), jnp.sum(mask)


def _sites_at_triangles(contact: "Contact", x, first, second, room, held, sizes: Room):
    """Sites of the first triangles of the pairs that lie near the second ones, as pair * s + site."""
    corners = tuple(tuple(c[:, None] for c in corner) for corner in gather(x, second))
    point = _positions(contact, gather(x, first))
    reach = contact.range + room
    close = point_triangle(point, *corners) <= (reach * reach)[:, None]
    return _compact((close & held[:, None]).reshape(-1), sizes.sites)


def _positions(contact: "Contact", corners: tuple[Vec, ...]) -> Vec:
    """All sites (m, s) of triangles with `corners` of components (m,)."""
    w = contact.weights.T
    return tuple(  # type: ignore[return-value]
        sum(corner[i][:, None] * w[k] for k, corner in enumerate(corners)) for i in range(3)
    )


def _site(contact: "Contact", corners: tuple[Vec, ...], site: Array) -> Vec:
    """One site (m, 1) of each of m triangles."""
    w = contact.weights[site]
    return tuple(  # type: ignore[return-value]
        sum(corner[i] * w[:, k] for k, corner in enumerate(corners))[:, None] for i in range(3)
    )


def _site_pairs(contact: "Contact", x, slack, pairs, triangles, apart, room, sites, sizes: Room) -> Near:
    """Pairs of a site found near a triangle with the sites of that triangle."""
    (place, pair_count), (found, site_count) = pairs, sites
    count = contact.weights.shape[0]
    owner, site = found // count, found % count
    one, two = (contact.faces[triangles[owner, k]] for k in range(2))
    limit = (contact.range + room)[owner]
    near = _squared(contact, x, one, two, site) < (limit * limit)[:, None]
    excluded = (EXCLUSION * contact.range) ** 2
    meet = near & (_squared(contact, contact.rest, one, two, site) >= excluded)
    held = jnp.arange(sizes.sites) < site_count
    picked, total = _compact((meet & held[:, None]).reshape(-1), sizes.pairs)
    row, other = picked // count, picked % count
    listed = jnp.arange(sizes.pairs) < total
    weights = jnp.concatenate([contact.weights[site[row]], -contact.weights[other]], axis=1)
    areas = contact.density[triangles[owner[row]]]
    strength = contact.share[site[row]] * areas[:, 0] * contact.share[other] * areas[:, 1]
    overflow = jnp.stack([pair_count > sizes.triangles, site_count > sizes.sites, total > sizes.pairs])
    return Near(
        place, triangles, apart, pair_count,
        jnp.concatenate([one[row], two[row]], axis=1), weights, jnp.where(listed, strength, 0.0),
        jnp.where(listed, owner[row], sizes.triangles).astype(jnp.int32), total, x, slack, overflow, sizes.sites,
    )  # fmt: skip


def _squared(contact: "Contact", x: Array, one: Array, two: Array, site: Array) -> Array:
    """Squared distances (k, s) of one site of each triangle `one` (k, 3) from all of `two` (k, 3)."""
    r = sub(_site(contact, gather(x, one), site), _positions(contact, gather(x, two)))
    return dot(r, r)
