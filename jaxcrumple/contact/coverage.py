"""Whether neighbour lists are valid at new positions."""

import jax
import jax.numpy as jnp
from jax import Array

from jaxcrumple.contact.adjacency import DUE_TURN, largest_turn
from jaxcrumple.contact.lists import CandidatePairs, ContactLists
from jaxcrumple.contact.parameters import Contact

# Sites that may interact are at least EXCLUSION ranges apart at rest. No pair interacts if every distance is
# more than half of its value at rest: APART adds a margin, APART_AHEAD a larger one for a predicted step.
APART, APART_AHEAD = 0.55, 0.6


def covers(contact: Contact, lists: ContactLists | None, x: Array, start: Array | None = None) -> Array:
    """Return whether the lists are valid at positions `x` (n, 3) in m.

    They are if no node has left its skin, or if the sheet is so flat that it needs no lists at `x` and on the
    straight path from `start` (n, 3). Without lists, only the second counts.
    """
    start = x if start is None else start
    if lists is None:
        return apart(contact, start, x)
    listed = lists.candidates.covers(x) & lists.pairs.covers(x)
    listed = listed if lists.active is None else listed & lists.active.covers(x)
    return jax.lax.cond(listed, lambda: listed, lambda: apart(contact, start, x))


def apart(contact: Contact, start: Array, end: Array, share: float = APART) -> Array:
    """Return whether `Contact.chart` proves that no sites interact on a straight path between two positions.

    `start`, `end` (n, 3): ends of the path; `share`: least ratio of distances to those at rest that the proof
    requires. Without a proof the result is False.
    """
    if contact.chart is None:
        return jnp.asarray(False)
    start, end = jax.lax.stop_gradient((start, end))
    frame = contact.chart.frame(start)
    return (contact.chart.least(start, frame) > share) & (contact.chart.least(end, frame) > share)


def largest_unlisted_turn(contact: Contact, candidates: CandidatePairs, theta: Array) -> Array:
    """Return the largest turn in rad of the ways at nodes that the candidates do not list.

    `theta` (h,): hinge angles in rad. If an upper bound is below `DUE_TURN`, the result is that bound.
    """
    bound = candidates.turn + contact.fans.longest * jnp.max(jnp.abs(theta - candidates.theta))
    return jax.lax.cond(
        bound < DUE_TURN,
        lambda: bound,
        lambda: largest_turn(contact.fans.turning(theta), candidates.folded),
    )
