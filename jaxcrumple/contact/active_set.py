"""Select the site pairs that interact now, and the pairs of triangles that may touch."""

from functools import reduce
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxcrumple._jax.arrays import Count, NodeVectors, Scalar
from jaxcrumple._jax.padded import compacted
from jaxcrumple.contact.lists import TRIANGLES, ActiveSet, ContactLists, Reference, SitePairs
from jaxcrumple.contact.parameters import Contact
from jaxcrumple.geometry.hinge import Vec, add, dot, gather, scale

# Offset of squared distances of sites in m2 against a zero root, far below any squared distance that matters.
TINY = 1e-30
# Site pairs per chunk in the test of listed distances and of current distances.
LISTED, SIFTED = 4096, 1024


def find_active(contact: Contact, lists: ContactLists, reference: Reference) -> ActiveSet:
    """Find the pairs that may interact or touch within motions `reference`, which `lists.pairs` covers."""
    contact, pairs, reference = jax.lax.stop_gradient((contact, lists.pairs, reference))
    moves = pairs.approach_of(contact.faces, reference.skin)
    limit = contact.range + moves
    rough = _roughly(contact, pairs, reference.x, limit)
    places, count = _sifted(contact, pairs, reference.x, rough, limit)
    close = _within(pairs, pairs.approach(contact.faces, reference.x) + moves)
    return ActiveSet(reference, places, count, *close)


def likely(contact: Contact, lists: ContactLists, x: NodeVectors) -> tuple[Int[Array, " pairs"], Count]:
    """Return a superset (P,) of the site pairs that interact at positions `x` (n, 3), and its size.

    Entries are places in `lists.pairs`. An active set, if present, is returned as it is.
    """
    if lists.active is not None:
        return lists.active.pairs, lists.active.count
    return _roughly(contact, lists.pairs, x, contact.range)


def interacting(
    contact: Contact, lists: ContactLists, x: NodeVectors, nearer: float = 1.0
) -> tuple[Int[Array, " pairs"], Count]:
    """Return the site pairs (P,) that interact at positions `x` (n, 3), and how many there are.

    `nearer` multiplies the distances. The result does not depend on when the lists were built.
    """
    limit = contact.range / nearer
    rough = likely(contact, lists, x) if nearer == 1.0 else _roughly(contact, lists.pairs, x, limit)
    return _sifted(contact, lists.pairs, x, rough, limit)


def may_touch(
    contact: Contact, lists: ContactLists, *positions: NodeVectors
) -> tuple[Int[Array, " triangles"], Count]:
    """Return a superset (T,) of the pairs of triangles that may touch, and its size.

    Nodes move between `positions` (n, 3). Entries are places in `SitePairs.triangles`.
    """
    if lists.active is not None:
        return lists.active.close, lists.active.close_count
    return _within(lists.pairs, lists.pairs.approach(contact.faces, *positions))


def _within(pairs: SitePairs, moves: Float[Array, " triangles"]) -> tuple[Int[Array, " triangles"], Count]:
    """Return the places (T,) of pairs of triangles that may touch if they approach by `moves` (T,) m, and how
    many there are."""
    return compacted(
        lambda at: (pairs.distance[at] <= moves[at])[:, None],
        pairs.triangle_count, 1, pairs.capacity.triangles, TRIANGLES,
    )  # fmt: skip


def _roughly(
    contact: Contact, pairs: SitePairs, x: NodeVectors, limit: Scalar | Float[Array, " triangles"]
) -> tuple[Int[Array, " pairs"], Count]:
    """Return the site pairs that may be closer than `limit` in m, () or (T,), at positions `x` (n, 3).

    The bound uses the distances at the last rebuild and how far the triangles have moved since. It rejects
    nine pairs in ten without computing their current distance.
    """
    contact, pairs, x, limit = jax.lax.stop_gradient((contact, pairs, x, limit))
    reach = limit + pairs.approach(contact.faces, x)

    def may(at: Int[Array, " chunk"]) -> Bool[Array, "chunk 1"]:
        return (pairs.apart[at] < reach[pairs.owner[at]])[:, None]

    return compacted(may, pairs.count, 1, pairs.capacity.pairs, LISTED)


def _sifted(
    contact: Contact,
    pairs: SitePairs,
    x: NodeVectors,
    rough: tuple[Int[Array, " pairs"], Count],
    limit: Scalar | Float[Array, " triangles"],
) -> tuple[Int[Array, " pairs"], Count]:
    """Return the pairs of `rough` that are closer than `limit` by their current distance."""
    contact, pairs, x, limit = jax.lax.stop_gradient((contact, pairs, x, limit))
    places, count = rough

    def close(at: Int[Array, " chunk"]) -> Bool[Array, "chunk 1"]:
        terms = pair_terms(contact, pairs, places[at], jnp.ones_like(at, bool))
        most = limit if limit.ndim == 0 else limit[terms.owner]
        return (separation(terms, x)[1] < most)[:, None]

    return compacted(close, count, 1, pairs.capacity.pairs, SIFTED, lambda at: places[at])


class PairTerms(NamedTuple):
    """Hold what the energy of p site pairs depends on.

    `nodes` (p, 6): of the two triangles; `weights` (p, 6): of these nodes in $r_{12}$; `strength` (p,):
    product of the two site areas over $a_0^2$, or 0 for an unused entry; `owner` (p,): place in
    `SitePairs.triangles`.
    """

    nodes: Int[Array, "pairs 6"]
    weights: Float[Array, "pairs 6"]
    strength: Float[Array, " pairs"]
    owner: Int[Array, " pairs"]


def pair_terms(
    contact: Contact, pairs: SitePairs, places: Int[Array, " pairs"], held: Bool[Array, " pairs"]
) -> PairTerms:
    """Return the terms of the site pairs at `places` (p,); those not `held` (p,) get strength 0."""
    owner, first, second = (part[places] for part in (pairs.owner, pairs.first, pairs.second))
    triangles = pairs.triangles[owner]
    columns = [contact.faces[:, k][triangles[:, side]] for side in range(2) for k in range(3)]
    nodes = jnp.stack(columns, axis=1)
    shares = [sign * contact.weights[:, k][at] for sign, at in ((1, first), (-1, second)) for k in range(3)]
    weights = jnp.stack(shares, axis=1)
    one = contact.share[first] * contact.density[triangles[:, 0], contact.place[first]]
    two = contact.share[second] * contact.density[triangles[:, 1], contact.place[second]]
    return PairTerms(nodes, weights, jnp.where(held, one * two, 0.0), owner)


def separation(terms: PairTerms, x: NodeVectors) -> tuple[Float[Array, "pairs 3"], Float[Array, " pairs"]]:
    """Return $r_{12}$ (p, 3) of (26) in m and its length (p,)."""
    corners = gather(x, terms.nodes)
    parts = [scale(terms.weights[:, k], corner) for k, corner in enumerate(corners)]
    r = reduce(add, parts)
    return jnp.stack(r, axis=1), jnp.sqrt(dot(r, r) + TINY)


def with_push(forces: Vec, terms: PairTerms, push: Float[Array, "3 pairs"]) -> Vec:
    """Add to nodal `forces`, three components (n,), the force `push` (3, p) on the first site of each pair
    and its reaction on the second. XLA on CPU adds components faster than rows of three."""
    nodes = terms.nodes.reshape(-1)
    shares = ((terms.weights * along[:, None]).reshape(-1) for along in push)
    x, y, z = (total.at[nodes].add(share) for total, share in zip(forces, shares, strict=True))
    return x, y, z
