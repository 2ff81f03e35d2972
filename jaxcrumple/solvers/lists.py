"""Keeping the lists of contact valid while a run goes on, and refusing steps that would pass through something."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from jaxcrumple.model.fans import DUE_TURN, MOST_TURN
from jaxcrumple.model.near import Near, find_near, motion, slack_for
from jaxcrumple.model.scene import Scene, with_near
from jaxcrumple.system import Listing, State

# Share of what a list allows for that a predicted step may use.
USED = 0.9
# Reach of a new list of candidates: ranges, and steps like the next one; it need not be more than lets a flat sheet
# have no candidates, but is FEWEST steps at least.
REACH, STEPS, FEWEST = 0.35, 32.0, 4.0


class Prepared(NamedTuple):
    """A scene whose lists hold for the next step, or the `listing` that must be searched for before."""

    scene: Scene
    near: Near | None
    listing: Listing | None
    ready: Array


def start_lists(scene: Scene, state: State) -> tuple[State, Near | None]:
    """Pairs of sites near the state's positions, and the state, which says whether a search is due first."""
    contact, listing = scene.contact, state.listing
    if contact is None or listing is None:
        return state, None
    near = find_near(contact, state.x, slack_for(contact, state.x, state.x))
    known = contact.candidates.made_for(listing.x, listing.reach)
    due = Listing(listing.x, listing.reach, ~known, near.overflow & known)
    return eqx.tree_at(lambda s: s.listing, state, due), near


def waits(state: State) -> Array:
    """Whether the state waits for a search or for longer lists."""
    listing = state.listing
    return jnp.asarray(False) if listing is None else listing.stale | jnp.any(listing.overflow)


def listed(scene: Scene, near: Near | None) -> Scene:
    """The scene with the list `near`."""
    return scene if near is None else with_near(scene, near)


def largest_move(scene: Scene, x: Array, ahead: Array) -> Array:
    """Share of the way to `ahead` (n, 3) that one step may go: lists for more would hold too much."""
    assert scene.contact is not None
    moved = jnp.max(motion(x, ahead))
    return jnp.minimum(scene.contact.stride / jnp.maximum(moved, 1e-300), 1.0)


def prepare(scene: Scene, state: State, near: Near | None, ahead: Array) -> Prepared:
    """Make the lists hold for a step from the state to `ahead` (n, 3), as far as that goes in the program."""
    contact, listing = scene.contact, state.listing
    if contact is None or near is None or listing is None:
        return Prepared(scene, None, None, jnp.asarray(True))
    known = contact.candidates.made_for(listing.x, listing.reach)
    within = jnp.all(motion(contact.candidates.x, ahead) <= USED * contact.candidates.reach)
    theta = scene.bending.hinges(state.x).theta
    fresh = known & within & (contact.sharpest(theta) < DUE_TURN)
    held = jnp.all(motion(near.x, ahead) <= USED * near.slack)
    slack = slack_for(contact, state.x, ahead)
    near = jax.lax.cond(held | ~fresh, lambda: near, lambda: find_near(contact, state.x, slack))
    moved = motion(state.x, ahead)
    reach = REACH * contact.range + STEPS * moved
    least = REACH * contact.range + FEWEST * moved
    reach = jnp.minimum(reach, jnp.maximum(contact.calm, least))
    due = Listing(
        jnp.where(fresh, listing.x, state.x),
        jnp.where(fresh, listing.reach, reach),
        ~fresh,
        near.overflow & fresh,
    )
    return Prepared(with_near(scene, near), near, due, fresh & ~jnp.any(near.overflow))


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
