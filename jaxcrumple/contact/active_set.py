"""The active set: the site pairs that interact now, and the pairs of triangles that may touch.

This is the third tier, below the two of `jaxcrumple.contact.lists`. A list of site pairs is valid for dozens
of explicit steps, but most of its pairs are out of range in each of them. `Active` keeps only the pairs that
may come within range in the next steps.
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

# Offset of squared distances of sites in m2 against a zero root, far below any squared distance that matters.
TINY = 1e-30
# Factor on the distances for the tangent of `Contact.nearer_product`: the stability limit that follows from
# it must remain valid while sites approach further.
CLOSER = 0.98
# Pairs per chunk: site pairs in the test of listed distances and of current distances, pairs of triangles.
LISTED, SIFTED, TRIANGLES = 4096, 1024, 1024


class Active(eqx.Module):
    """Hold the part of a `Near` list that matters for the small motions `around`, for which `Near` is valid.

    `picked` (P,): site pairs as in `Near.picked`; the first `count` may interact; `count` is -1 before the
    pairs are found. `doubted` (T,): places of pairs of triangles in `Near.triangles`; the first
    `doubted_count` may touch.
    """

    picked: Array
    count: Array
    doubted: Array
    doubted_count: Array
    around: Around


def no_active(n: int, sites: int, room: Room) -> Active:
    """Return an empty active set, marked as not yet found, for `n` nodes and `sites` sites per triangle."""
    picked = jnp.zeros(room.pairs, place_type(room.sites * sites))
    doubted, zero = jnp.zeros(room.triangles, jnp.int32), jnp.asarray(0, int)
    return Active(picked, jnp.asarray(-1, int), doubted, zero, nowhere(n))


def find_active(contact: "Contact", around: Around) -> Active:
    """Find the pairs that may interact or touch within the motions `around`, which `contact.near` covers."""
    contact, around = jax.lax.stop_gradient((contact, around))
    near, faces = contact.near, contact.faces
    moves = near.nearer(faces, around.reach)
    limit = contact.range + moves
    picked, count = _sifted(contact, around.x, _roughly(contact, around.x, limit), limit)
    doubted = _within(near, near.moved(faces, around.x) + moves)
    return Active(picked, count, *doubted, around)


def likely(contact: "Contact", x: Array) -> tuple[Array, Array]:
    """Return a superset (P,) of the site pairs that interact at positions `x` (n, 3), and its size.

    Entries are those of `Near.picked`. An active set, if present, is returned as it is.
    """
    if contact.active is not None:
        return contact.active.picked, contact.active.count
    return _roughly(contact, x, contact.range)


def interacting(contact: "Contact", x: Array, nearer: float = 1.0) -> tuple[Array, Array]:
    """Return the site pairs (P,) that interact at positions `x` (n, 3), and how many there are.

    `nearer` multiplies the distances. The result does not depend on when the lists were built.
    """
    limit = contact.range / nearer
    rough = likely(contact, x) if nearer == 1.0 else _roughly(contact, x, limit)
    return _sifted(contact, x, rough, limit)


def may_touch(contact: "Contact", *positions: Array) -> tuple[Array, Array]:
    """Return a superset (T,) of the pairs of triangles that may touch, and its size.

    Nodes move between `positions` (n, 3). Entries are places in `Near.triangles`.
    """
    if contact.active is not None:
        return contact.active.doubted, contact.active.doubted_count
    return _within(contact.near, contact.near.moved(contact.faces, *positions))


def _within(near: Near, moves: Array) -> tuple[Array, Array]:
    """Return the places (T,) of pairs of triangles that may touch if they approach by `moves` (T,) m, and how
    many there are."""
    return compacted(
        lambda at: (near.distance[at] <= moves[at])[:, None],
        near.pair_count, 1, near.room.triangles, TRIANGLES,
    )  # fmt: skip


def _roughly(contact: "Contact", x: Array, limit: Array) -> tuple[Array, Array]:
    """Return the site pairs that may be closer than `limit` in m, () or (T,), at positions `x` (n, 3).

    The bound uses the distances at the last rebuild and how far the triangles have moved since. It rejects
    nine pairs in ten without computing their current distance.
    """
    contact, x, limit = jax.lax.stop_gradient((contact, x, limit))
    near = contact.near
    reach = limit + near.moved(contact.faces, x)

    def may(at: Array) -> Array:
        return (near.apart[at] < reach[near.owner[at]])[:, None]

    return compacted(may, near.site_count, 1, near.room.pairs, LISTED, lambda at: near.picked[at])


def _sifted(contact: "Contact", x: Array, rough: tuple[Array, Array], limit: Array) -> tuple[Array, Array]:
    """Return the pairs of `rough` that are closer than `limit` by their current distance."""
    contact, x, limit = jax.lax.stop_gradient((contact, x, limit))
    picked, count = rough

    def close(at: Array) -> Array:
        pairs = site_pairs(contact, picked[at], jnp.ones_like(at, bool))
        most = limit if limit.ndim == 0 else limit[pairs.owner]
        return (separation(pairs, x)[1] < most)[:, None]

    return compacted(close, count, 1, contact.near.room.pairs, SIFTED, lambda at: picked[at])


class SitePairs(NamedTuple):
    """Hold p site pairs.

    `nodes` (p, 6): of the two triangles; `weights` (p, 6): of these nodes in $r_{12}$; `strength` (p,):
    product of the two site areas over $a_0^2$, or 0 for an unused entry; `owner` (p,): place in
    `Near.triangles`.
    """

    nodes: Array
    weights: Array
    strength: Array
    owner: Array


def site_pairs(contact: "Contact", picked: Array, held: Array) -> SitePairs:
    """Return the site pairs `picked` (p,), entries of `Near.picked`; those not `held` (p,) get strength 0."""
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
    """Return $r_{12}$ (p, 3) of (26) in m and its length (p,)."""
    corners = gather(x, pairs.nodes)
    parts = [scale(pairs.weights[:, k], corner) for k, corner in enumerate(corners)]
    r = reduce(add, parts)
    return jnp.stack(r, axis=1), jnp.sqrt(dot(r, r) + TINY)


def with_push(forces: Array, pairs: SitePairs, push: Array) -> Array:
    """Add to nodal `forces` (n, 3) the force `push` (p, 3) on the first site of each pair and its reaction on
    the second."""
    return forces.at[pairs.nodes].add(pairs.weights[:, :, None] * push[:, None])
