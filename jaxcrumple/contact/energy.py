"""Self-contact between refined sites (Section 2.5): the potential, its forces and its tangent.

Every triangle carries a lattice of sites (Fig. 2), and each site represents an area. The paper's sum over
site pairs then becomes a quadrature of $\\int\\int U(r)\\,dA\\,dA/a_0^2$. Here $a_0 = \\sqrt 3\\sigma^2/2$ is
the area of a site in a lattice of spacing $\\sigma$. The stiffness per area therefore does not depend on the
refinement or on the triangle. On a lattice of triangles of height $\\sigma$ these are the paper's (26)-(28).
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxcrumple._jax.arrays import Count, NodeValues, NodeVectors, Scalar
from jaxcrumple._jax.padded import accumulate
from jaxcrumple._jax.stored_programs import StoredJit
from jaxcrumple.contact.active_set import (
    PairTerms,
    interacting,
    likely,
    pair_terms,
    separation,
    with_push,
)
from jaxcrumple.contact.coverage import covers
from jaxcrumple.contact.lists import ContactLists, SitePairs
from jaxcrumple.contact.parameters import Contact
from jaxcrumple.geometry.hinge import Vec
from jaxcrumple.model.elements import upper_pairs

# Site pairs per chunk of a sum.
ADDED = 512
# Factor on the distances for the tangent of `nearer_product`: the stability limit that follows from it must
# remain valid while sites approach further.
CLOSER = 0.98

_Tangent = tuple[Float[Array, "blocks 9"], Float[Array, "triangles 9 9"], NodeValues]


def energy(contact: Contact, lists: ContactLists, x: NodeVectors) -> Scalar:
    """Return the energy in J at positions `x` (n, 3); NaN where the lists are not valid."""

    def add(total: Scalar, contact: Contact, x: NodeVectors, terms: PairTerms) -> Scalar:
        _, distance = separation(terms, x)
        return total + jnp.sum(terms.strength * _potential(contact, distance))

    return _sum(contact, lists, x, interacting, add, jnp.zeros((), x.dtype))


def force(contact: Contact, lists: ContactLists, x: NodeVectors) -> NodeVectors:
    """Return the nodal forces (n, 3) in N, (27)-(28); NaN where the lists are not valid."""

    def add(total: Vec, contact: Contact, x: NodeVectors, terms: PairTerms) -> Vec:
        r, distance = separation(terms, x)
        return with_push(total, terms, -terms.strength * _slope(contact, distance) / distance * r.T)

    return jnp.stack(_sum(contact, lists, x, likely, add, _no_forces(x)), axis=1)


def add_tangent(
    contact: Contact,
    lists: ContactLists,
    x: NodeVectors,
    own: Float[Array, "blocks 9"],
    face_blocks: Int[Array, "faces 6"],
) -> _Tangent:
    """Compute the Hessian in N/m at positions `x` (n, 3): (A.10) with corrected sign.

    A compressed pair adds negative transverse (geometric) stiffness. It cancels if both layers move
    together, but not in the block of one layer alone.

    **Arguments:** `own` (b, 9): blocks of the sheet; `face_blocks` (f, 6): index in `own` of the blocks
    within each triangle.

    **Returns:** `own` with the contact stiffness within triangles added; blocks (T, 9, 9) between the nodes
    of the two triangles of each listed pair; and a diagonal (n,) that compensates the negative stiffness in
    `own` where the solver uses `own` without the blocks. `own` is NaN where the lists are not valid.
    """
    one, two = np.array(upper_pairs(3)).T
    triangles = lists.pairs.triangles

    def add(total: _Tangent, contact: Contact, x: NodeVectors, terms: PairTerms) -> _Tangent:
        own, cross, lift = total
        r, distance = separation(terms, x)
        matrix, tension = _matrices(contact, terms, r / distance[:, None], distance)
        matrix = matrix.reshape(-1, 1, 9)
        for side in range(2):
            blocks = face_blocks[triangles[terms.owner, side]]
            weights = terms.weights[:, 3 * side : 3 * side + 3]
            own = own.at[blocks].add((weights[:, one] * weights[:, two])[:, :, None] * matrix)
        both = (terms.weights[:, :3, None] * terms.weights[:, None, 3:]).reshape(-1, 9, 1)
        soft = jnp.abs(terms.weights) * jnp.maximum(-tension, 0.0)[:, None]
        return own, cross.at[terms.owner].add(both * matrix), lift.at[terms.nodes].add(soft)

    nothing = own, jnp.zeros((triangles.shape[0], 9, 9), x.dtype), jnp.zeros(x.shape[0], x.dtype)
    # Most blocks are unused: to mark them too would cost another pass over all of them.
    own, *others = _added(contact, lists.pairs, x, interacting(contact, lists, x), add, nothing)
    return jnp.where(covers(lists, x), own, jnp.nan), *others


def nearer_product(
    contact: Contact, lists: ContactLists, x: NodeVectors
) -> Callable[[NodeVectors], NodeVectors]:
    """Return the product of the Hessian with displacements (n, 3) in m, as a function; it gives N.

    The Hessian is that at positions `x` (n, 3), but with all distances reduced by `CLOSER`, since motion may
    reduce them.
    """
    found, holds = interacting(contact, lists, x, CLOSER), covers(lists, x)

    def add(total: Vec, contact: Contact, both: tuple[NodeVectors, NodeVectors], terms: PairTerms) -> Vec:
        (r, distance), (change, _) = separation(terms, both[0]), separation(terms, both[1])
        matrix, _ = _matrices(
            contact, terms, r / distance[:, None], contact.potential.closer(distance, CLOSER)
        )
        return with_push(total, terms, jnp.sum(matrix * change[:, None], axis=2).T)

    def product(u: NodeVectors) -> NodeVectors:
        total = _added(contact, lists.pairs, (x, u), found, add, _no_forces(x))
        return jnp.where(holds, jnp.stack(total, axis=1), jnp.nan)

    return product


@StoredJit
def closest_sites(contact: Contact, lists: ContactLists, x: NodeVectors) -> tuple[Scalar, Count, Count]:
    """Find the closest interacting site pair at positions `x` (n, 3).

    **Returns:** its distance in m, infinite if no sites interact; the number of interacting site pairs; and
    the place of the closest pair in `SitePairs.triangles`.
    """
    pairs = lists.pairs
    places = jnp.arange(pairs.capacity.pairs)
    terms = pair_terms(contact, pairs, places, places < pairs.count)
    _, distance = separation(terms, x)
    pushing = (terms.strength > 0) & (distance < contact.range)
    gaps = jnp.where(pushing, distance, jnp.inf)
    return jnp.min(gaps), jnp.sum(pushing), terms.owner[jnp.argmin(gaps)]


def _no_forces(x: NodeVectors) -> Vec:
    """Return nodal forces of zero by components (n,), to which `with_push` adds."""
    return 3 * (jnp.zeros(len(x), x.dtype),)


def _potential(contact: Contact, distance: Float[Array, " *axes"]) -> Float[Array, " *axes"]:
    return contact.potential.energy(distance, contact.stiffness, contact.range)


def _slope(contact: Contact, distance: Float[Array, " pairs"]) -> Float[Array, " pairs"]:
    return jax.vmap(jax.grad(lambda r: _potential(contact, r)))(distance)


def _stiffness(contact: Contact, distance: Float[Array, " pairs"]) -> Float[Array, " pairs"]:
    return jax.vmap(jax.grad(jax.grad(lambda r: _potential(contact, r))))(distance)


def _matrices(
    contact: Contact, terms: PairTerms, direction: Float[Array, "pairs 3"], distance: Float[Array, " pairs"]
) -> tuple[Float[Array, "pairs 3 3"], Float[Array, " pairs"]]:
    """Return the stiffness (p, 3, 3) in N/m of site pairs, and the transverse stiffness (p,).

    `direction` (p, 3): unit vectors between the sites; `distance` (p,) in m.
    """
    tension = terms.strength * _slope(contact, distance) / distance
    along = direction[:, :, None] * direction[:, None, :]
    stiffness = (terms.strength * _stiffness(contact, distance) - tension)[:, None, None]
    return stiffness * along + tension[:, None, None] * jnp.eye(3), tension


def _sum(
    contact: Contact,
    lists: ContactLists,
    x: NodeVectors,
    find: Callable[..., tuple[Int[Array, " pairs"], Count]],
    add: Callable[..., Any],
    nothing: Any,
) -> Any:
    """Add the contributions of the pairs that `find` selects to `nothing`; NaN where lists are not valid."""
    value, holds = _added(contact, lists.pairs, x, find(contact, lists, x), add, nothing), covers(lists, x)
    return jax.tree.map(lambda total: jnp.where(holds, total, jnp.nan), value)


def _added(
    contact: Contact,
    pairs: SitePairs,
    x: NodeVectors | tuple[NodeVectors, NodeVectors],
    found: tuple[Int[Array, " pairs"], Count],
    add: Callable[..., Any],
    nothing: Any,
) -> Any:
    """Add the contributions of the site pairs `found`, as `likely` returns them, to `nothing`.

    `x`: array (n, 3), or a tuple of such arrays.
    """
    places, count = found

    def add_at(
        total: Any,
        arguments: tuple[Contact, SitePairs, Any, Int[Array, " pairs"]],
        at: Int[Array, " chunk"],
        held: Bool[Array, " chunk"],
    ) -> Any:
        contact, pairs, x, places = arguments
        # An unused entry could lie in the core of a barrier, and infinity times 0 is NaN.
        return add(total, contact, x, pair_terms(contact, pairs, places[jnp.where(held, at, 0)], held))

    arguments = (contact, pairs, x, places)
    return accumulate(add_at, nothing, arguments, count, places.shape[0], ADDED)
