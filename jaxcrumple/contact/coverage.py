"""Whether neighbour lists are valid at new positions."""

import jax
import jax.numpy as jnp

from jaxcrumple._jax.arrays import Flag, NodeVectors, Scalar
from jaxcrumple.contact.adjacency import DUE_TURN, largest_turn
from jaxcrumple.contact.lists import CandidatePairs, ContactLists
from jaxcrumple.contact.parameters import Contact
from jaxcrumple.geometry.hinge import HalfAngle


def covers(lists: ContactLists, x: NodeVectors) -> Flag:
    """Return whether all lists are valid at positions `x` (n, 3) in m: whether no node has left a skin."""
    valid = lists.candidates.covers(x) & lists.pairs.covers(x)
    return valid if lists.active is None else valid & lists.active.covers(x)


def largest_unlisted_turn(contact: Contact, candidates: CandidatePairs, half: HalfAngle) -> Scalar:
    """Return the largest turn in rad of the ways at nodes that the candidates do not list.

    `half` (h,): halves of the hinge angles. If an upper bound is below `DUE_TURN`, the result is that bound.
    """
    change = half.minus(candidates.half)
    # More than 180 degrees count as 180: no bound is below DUE_TURN then.
    sine = jnp.max(jnp.where(change.cosine < 0, 1.0, jnp.abs(change.sine)))
    bound = candidates.turn + contact.fans.longest * 2.0 * jnp.arcsin(jnp.minimum(sine, 1.0))
    return jax.lax.cond(
        bound < DUE_TURN,
        lambda: bound,
        lambda: largest_turn(contact.fans.turning(half.angle), candidates.folded),
    )
