"""Whether neighbour lists are valid at new positions."""

import jax
import jax.numpy as jnp

from jaxcrumple._jax.arrays import Flag, HingeValues, NodeVectors, Scalar
from jaxcrumple.contact.adjacency import DUE_TURN, largest_turn
from jaxcrumple.contact.lists import CandidatePairs, ContactLists
from jaxcrumple.contact.parameters import Contact


def covers(lists: ContactLists, x: NodeVectors) -> Flag:
    """Return whether all lists are valid at positions `x` (n, 3) in m: whether no node has left a skin."""
    valid = lists.candidates.covers(x) & lists.pairs.covers(x)
    return valid if lists.active is None else valid & lists.active.covers(x)


def largest_unlisted_turn(contact: Contact, candidates: CandidatePairs, theta: HingeValues) -> Scalar:
    """Return the largest turn in rad of the ways at nodes that the candidates do not list.

    `theta` (h,): hinge angles in rad. If an upper bound is below `DUE_TURN`, the result is that bound.
    """
    bound = candidates.turn + contact.fans.longest * jnp.max(jnp.abs(theta - candidates.theta))
    return jax.lax.cond(
        bound < DUE_TURN,
        lambda: bound,
        lambda: largest_turn(contact.fans.turning(theta), candidates.folded),
    )
