"""Keeping the lists of contact valid while a run goes on, and refusing steps that would pass through
something."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from jaxcrumple.model.contact import Contact
from jaxcrumple.model.fans import DUE_TURN, MOST_TURN
from jaxcrumple.model.grid import find_candidates
from jaxcrumple.model.near import (
    ONE,
    TIGHT_SLACK,
    Candidates,
    Near,
    Tight,
    find_near,
    motion,
    slack_for,
    whole,
)
from jaxcrumple.model.scene import Scene, with_near
from jaxcrumple.system import NEVER, Listing, State

# Share of what a list allows for that a predicted step may use.
USED = 0.9
# Share of the largest move that a step without any before it may make.
UNKNOWN = 0.25
# A tight list with slacks so many times those that a step needs is made anew.
LOOSE = 2.0
# Reach of a new list of candidates: ranges, and steps like the next one; it need not be more than lets a flat
# sheet have no candidates, but is FEWEST steps at least.
REACH, STEPS, FEWEST = 0.35, 32.0, 2.0


class Lists(NamedTuple):
    """What the loop holds: pairs of sites `near`, and `tight` out of these; the `slack` (n,) that the next
    `near` must have, and whether it is `due`, before the next step; and the `candidates`, or None where the
    host searches for them."""

    candidates: Candidates | None
    near: Near
    tight: Tight
    slack: Array
    due: Array


def start_lists(scene: Scene, state: State, by_host: bool) -> tuple[State, Lists | None]:
    """Lists that hold nowhere, and the state, which says whether a search is due first: `by_host`, or in the
    program."""
    contact, listing = scene.contact, state.listing
    if contact is None or listing is None:
        return state, None
    known = contact.candidates.made_for(listing.x, listing.reach)
    none = jnp.zeros_like(listing.needed)
    state = eqx.tree_at(lambda s: s.listing, state, Listing(listing.x, listing.reach, ~known, none))
    slack = jnp.maximum(slack_for(contact, state.x, state.x), _back(state, jnp.asarray(False)))
    candidates = None if by_host else contact.candidates
    return state, Lists(candidates, contact.near, contact.tight, slack, jnp.asarray(True))


def waits(state: State, lists: Lists | None) -> Array:
    """Whether the state waits for the host: for a search or for longer lists."""
    listing = state.listing
    if listing is None or lists is None:
        return jnp.asarray(False)
    short = jnp.any(listing.needed > 0)
    return listing.stale | short if lists.candidates is None else short


def listed(scene: Scene, lists: Lists | None) -> Scene:
    """The scene with what is in the lists."""
    if lists is None:
        return scene
    if lists.candidates is not None:
        scene = eqx.tree_at(lambda s: s.contact.candidates, scene, lists.candidates)
    return with_near(scene, lists.near, lists.tight)


def renewed(scene: Scene, state: State, lists: Lists | None) -> tuple[State, Lists | None]:
    """The lists made anew at the state's positions where that is due; the state says whether they fitted."""
    if state.listing is None or lists is None:
        return state, None
    state, lists = _searched(scene, state, lists)
    contact = listed(scene, lists).contact
    assert contact is not None and state.listing is not None

    def anew() -> tuple[Near, Tight]:
        near = find_near(contact, state.x, lists.slack)
        return near, whole(near)

    near, tight = jax.lax.cond(lists.due, anew, lambda: (lists.near, lists.tight))
    room = contact.candidates.triangles.shape[0]
    needed = jnp.append(near.needed, contact.candidates.count)
    short = jnp.any(near.overflow) | (contact.candidates.count > room)
    state = eqx.tree_at(lambda s: s.listing.needed, state, jnp.where(short, needed, 0))
    return state, lists._replace(near=near, tight=tight, due=jnp.asarray(False))


def _searched(scene: Scene, state: State, lists: Lists) -> tuple[State, Lists]:
    """The candidates made anew where they are stale and the program makes them."""
    contact, listing, old = scene.contact, state.listing, lists.candidates
    if contact is None or listing is None or old is None:
        return state, lists

    def search() -> Candidates:
        theta = scene.bending.hinges(listing.x).theta
        return find_candidates(contact, theta, listing.x, listing.reach)

    candidates = jax.lax.cond(listing.stale, search, lambda: old)
    state = eqx.tree_at(lambda s: s.listing.stale, state, jnp.asarray(False))
    return state, lists._replace(candidates=candidates)


def largest_move(scene: Scene, x: Array, ahead: Array, known: Array | bool = True) -> Array:
    """Share of the way to `ahead` (n, 3) that one step may go, less where the way is not `known` from steps
    before: lists for more would hold too much."""
    assert scene.contact is not None
    most = jnp.where(known, 1.0, UNKNOWN) * scene.contact.stride
    return jnp.minimum(most / jnp.maximum(jnp.max(motion(x, ahead)), 1e-300), 1.0)


def ready_for(
    scene: Scene, state: State, lists: Lists | None, ahead: Array, held: Array
) -> tuple[State, Lists | None, Array]:
    """Whether the lists hold for a step from the state to `ahead` (n, 3); where not, what is due before.

    Unless the factor of the last tangent is `held`, they hold for that too.
    """
    contact, listing = listed(scene, lists).contact, state.listing
    if contact is None or listing is None or lists is None:
        return state, None, jnp.asarray(True)
    blunt = contact.sharpest(scene.bending.hinges(state.x).theta) < DUE_TURN
    stale = ~(contact.candidates.covers(ahead, USED) & blunt)
    moved = motion(state.x, ahead)
    reach = REACH * contact.range + STEPS * moved
    least = REACH * contact.range + FEWEST * moved
    reach = jnp.minimum(reach, jnp.maximum(contact.calm, least))
    wanted = Listing(
        jnp.where(stale, state.x, listing.x), jnp.where(stale, reach, listing.reach), stale, listing.needed
    )
    holds, back = lists.near.covers(ahead, USED), _back(state, held)
    slack = jnp.where(holds & ~stale, lists.slack, jnp.maximum(slack_for(contact, state.x, ahead), back))
    state = eqx.tree_at(lambda s: s.listing, state, wanted)
    tight = _tight_for(contact, state, lists.tight, ahead)
    ready = holds & ~stale
    return state, lists._replace(tight=tight, slack=slack, due=~ready), ready


def _back(state: State, held: Array) -> Array:
    """Slack (n,) that a list needs to hold where the last tangent was taken, if it must be taken again."""
    return jnp.where(held | (state.kept.age >= NEVER), 0.0, motion(state.x, state.kept.x) / USED)


def _tight_for(contact: Contact, state: State, tight: Tight, ahead: Array) -> Tight:
    """The tight list, made anew where it does not hold for a step to `ahead` (n, 3) or holds too much."""
    # In the middle of the way, so that both ends are as near as can be.
    middle = 0.5 * (state.x + ahead)
    slack = TIGHT_SLACK * contact.range + 0.5 * ONE * motion(state.x, ahead)
    loose = jnp.mean(tight.slack) > LOOSE * jnp.mean(slack)
    good = tight.covers(ahead, USED) & ~loose
    return jax.lax.cond(good, lambda: tight, lambda: contact.tightened(middle, slack))


def passes(scene: Scene, state: State, x: Array, t: Array) -> Array:
    """Whether a step to positions `x` (n, 3) at time `t` would pass through a wall or the sheet itself, or
    leaves the lists behind."""
    through = jnp.asarray(False)
    for wall in scene.walls:
        through = through | jnp.any((wall.gap(x, t) < 0) & (wall.gap(state.x, state.t) >= 0))
    contact = scene.contact
    if contact is None:
        return through
    sharp = contact.sharpest(scene.bending.hinges(x).theta) > MOST_TURN
    return through | ~contact.covers(x) | sharp | contact.crosses(state.x, x)
