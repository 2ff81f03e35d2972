"""Which pairs of sites in the lists interact here and now, and which pairs of triangles may touch.

The third tier, below those of `jaxcrumple.contact.lists`: a list of sites holds for dozens of explicit steps,
in each of which most of its pairs are out of range. `Active` tells those apart that may come within it soon.
"""

from functools import reduce
from typing import TYPE_CHECKING, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from jaxcrumple._jax.padded import compacted
from jaxcrumple.contact.lists import Around, Near, Room, nowhere, place_type, split
from jaxcrumple.geometry.hinge import add, dot, gather, scale

if TYPE_CHECKING:
    from jaxcrumple.contact.energy import Contact

# Guards the distance of two sites, m2: far below any distance that matters here.
TINY = 1e-30
# Room for motion that a tangent which is to hold for a while leaves: distances are so much of what they are.
CLOSER = 0.98
# Pairs that are looked at together: of sites, by how far apart they were or are, and of triangles.
LISTED, SIFTED, TRIANGLES = 4096, 1024, 1024


class Active(eqx.Module):
    """What a list of sites holds for small motions `around` positions where it holds itself.

    `picked` (P,): pairs as `Near.picked`, the first `count` of which may interact, -1 where they are yet to
    be found; `doubted` (T,): places of pairs of triangles, the first `doubted_count` of which may touch.
    """

    picked: Array
    count: Array
    doubted: Array
    doubted_count: Array
    around: Around


def no_active(n: int, sites: int, room: Room) -> Active:
    """One that has yet to be found, for so many `sites` a triangle."""
    picked = jnp.zeros(room.pairs, place_type(room.sites * sites))
    doubted, zero = jnp.zeros(room.triangles, jnp.int32), jnp.asarray(0, int)
    return Active(picked, jnp.asarray(-1, int), doubted, zero, nowhere(n))


def find_active(contact: "Contact", around: Around) -> Active:
    """Those that may interact or touch in any of some motions, for which the list of sites must hold too."""
    contact, around = jax.lax.stop_gradient((contact, around))
    near, faces = contact.near, contact.faces
    moves = near.nearer(faces, around.reach)
    limit = contact.range + moves
    picked, count = _sifted(contact, around.x, _roughly(contact, around.x, limit), limit)
    doubted = _within(near, near.moved(faces, around.x) + moves)
    return Active(picked, count, *doubted, around)


def likely(contact: "Contact", x: Array) -> tuple[Array, Array]:
    """Pairs of sites (P,) as in `Near.picked` among which are all that interact at positions `x` (n, 3), and
    how many they are."""
    if contact.active is not None:
        return contact.active.picked, contact.active.count
    return _roughly(contact, x, contact.range)


def interacting(contact: "Contact", x: Array, nearer: float = 1.0) -> tuple[Array, Array]:
    """Those that interact at positions `x` (n, 3), or would if distances were so much `nearer`: the same ones
    whenever the lists were made."""
    limit = contact.range / nearer
    rough = likely(contact, x) if nearer == 1.0 else _roughly(contact, x, limit)
    return _sifted(contact, x, rough, limit)


def may_touch(contact: "Contact", *positions: Array) -> tuple[Array, Array]:
    """Places (T,) of pairs of triangles among which are all that may touch between `positions` (n, 3), and
    how many they are."""
    if contact.active is not None:
        return contact.active.doubted, contact.active.doubted_count
    return _within(contact.near, contact.near.moved(contact.faces, *positions))


def _within(near: Near, moves: Array) -> tuple[Array, Array]:
    """Places of pairs of triangles that may touch where their points come nearer by `moves` (T,) m."""
    return compacted(
        lambda at: (near.distance[at] <= moves[at])[:, None],
        near.pair_count, 1, near.room.triangles, TRIANGLES,
    )  # fmt: skip


def _roughly(contact: "Contact", x: Array, limit: Array) -> tuple[Array, Array]:
    """Pairs of sites that may be as near as a `limit` in m, one for all or (T,), at positions `x` (n, 3):
    nine in ten are told by how far they were apart and how far their triangles have moved."""
    contact, x, limit = jax.lax.stop_gradient((contact, x, limit))
    near = contact.near
    reach = limit + near.moved(contact.faces, x)

    def may(at: Array) -> Array:
        return (near.apart[at] < reach[near.owner[at]])[:, None]

    return compacted(may, near.site_count, 1, near.room.pairs, LISTED, lambda at: near.picked[at])


def _sifted(contact: "Contact", x: Array, rough: tuple[Array, Array], limit: Array) -> tuple[Array, Array]:
    """Those of `rough` that are as near by their distance, which takes longer to tell."""
    contact, x, limit = jax.lax.stop_gradient((contact, x, limit))
    picked, count = rough

    def close(at: Array) -> Array:
        pairs = site_pairs(contact, picked[at], jnp.ones_like(at, bool))
        most = limit if limit.ndim == 0 else limit[pairs.owner]
        return (separation(pairs, x)[1] < most)[:, None]

    return compacted(close, count, 1, contact.near.room.pairs, SIFTED, lambda at: picked[at])


class SitePairs(NamedTuple):
    """Pairs of sites: `nodes` (p, 6) of their triangles and their `weights` in $r_{12}$, `strength`: the
    product of their areas over $a_0^2$, 0 where there is no pair, and `owner`: place in `Near.triangles`."""

    nodes: Array
    weights: Array
    strength: Array
    owner: Array


def site_pairs(contact: "Contact", picked: Array, held: Array) -> SitePairs:
    """Pairs of sites (p,) as in `Near.picked`, of which those `held` (p,) are valid."""
    near, sites = contact.near, contact.weights.shape[0]
    at, other = split(picked, sites)
    owner, site = split(near.found[at], sites)
    triangles = near.triangles[owner]
    columns = [contact.faces[:, k][triangles[:, side]] for side in range(2) for k in range(3)]
    nodes = jnp.stack(columns, axis=1)
    shares = [share * contact.weights[:, k][at] for share, at in ((1, site), (-1, other)) for k in range(3)]
    weights = jnp.stack(shares, axis=1)
    one = contact.share[site] * contact.density[triangles[:, 0], contact.place[site]]
    two = contact.share[other] * contact.density[triangles[:, 1], contact.place[other]]
    return SitePairs(nodes, weights, jnp.where(held, one * two, 0.0), owner)


def separation(pairs: SitePairs, x: Array) -> tuple[Array, Array]:
    """$r_{12}$ (p, 3) of (26) and its length."""
    corners = gather(x, pairs.nodes)
    parts = [scale(pairs.weights[:, k], corner) for k, corner in enumerate(corners)]
    r = reduce(add, parts)
    return jnp.stack(r, axis=1), jnp.sqrt(dot(r, r) + TINY)


def with_push(forces: Array, pairs: SitePairs, push: Array) -> Array:
    """Nodal `forces` (n, 3) with those of a `push` (p, 3) on the first site of each pair, and back."""
    return forces.at[pairs.nodes].add(pairs.weights[:, :, None] * push[:, None])
