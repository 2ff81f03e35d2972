"""Keeping the lists of contact valid while a run goes on, and refusing steps that would pass through
something."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from jaxcrumple._jax.batched_cond import where_needed
from jaxcrumple._jax.tree import select
from jaxcrumple.contact.active_set import Active, find_active, no_active
from jaxcrumple.contact.adjacency import DUE_TURN, MOST_TURN
from jaxcrumple.contact.broad_phase import find_candidates
from jaxcrumple.contact.energy import APART_AHEAD, Contact
from jaxcrumple.contact.lists import Around, Candidates, Near, first_room, motion, nowhere
from jaxcrumple.contact.narrow_phase import find_near
from jaxcrumple.model.walls import Wall
from jaxcrumple.scene import Scene, with_near
from jaxcrumple.state import NEVER, Listing, State

# How far, in ranges, a node may move in a step, less the mean motion; and in a step without any before
# it. Where nothing is near it may be as far as a flat sheet's neighbours do not appear, if that is more.
STRIDE, UNKNOWN = 1.0, 0.25
# A list of sites is made for SEVERAL steps as long as they go no further than WAY ranges, with some ROOM; one
# that reaches LOOSE times further than steps now need is made anew. All lists have to spare what a step may
# differ from its prediction, between SLACK and MOST_SLACK ranges: more would hold many flat neighbours.
SEVERAL, WAY, ROOM, SLACK, MOST_SLACK, LOOSE = 4.0, 0.25, 1.2, 0.05, 0.25, 2.0
# Ranges that a new list of sites has to spare beyond that, so that it holds for the steps after the next one.
HELD = 0.05
# Ranges that a list of sites reaches for the longest step where something is near.
LONGEST = 1.01 * (MOST_SLACK + HELD + 0.5 * ROOM * STRIDE)
# Ranges that an explicit step may differ from its prediction.
NEXT_SLACK = 0.01
# What is active is told for this many explicit steps, and so many ranges to spare.
ACTIVE_STEPS, ACTIVE_SLACK = 16.0, 0.02
# Reach of a list of candidates: ranges, and steps like the next one; of the latter FEWEST at least, and more
# only up to FURTHEST ranges, or as far as a flat sheet's neighbours do not appear.
REACH, STEPS, FEWEST, FURTHEST = 0.35, 16.0, 3.0, 2.0
# The same of pairs that have a place in the matrix; more only while a flat sheet has none.
PLACED_REACH, PLACED_FEWEST, PLACED_STEPS = 0.75, 2.0, 32.0


class Lists(NamedTuple):
    """What the loop holds: pairs of triangles that are `candidates`, and pairs of sites `near`; for which
    motions the next ones must be made (`wide`, `close`), and whether that is due, before the next step; and
    whether something was near a longer way, so that the next step must be a short one. `turn`: `sharpest` at
    the positions of an explicit stage, and `active` what interacts in its next steps."""

    candidates: Candidates
    near: Near
    wide: Around
    close: Around
    due: Array
    short: Array
    turn: Array
    active: Active | None


def without_places(scene: Scene) -> Scene:
    """The scene for a solver that does without one matrix, and so without places in it to wait for."""
    if scene.pattern.contact is None or scene.pattern.contact.merged is None:
        return scene
    return eqx.tree_at(lambda s: s.pattern.contact.merged, scene, None)


def start_lists(scene: Scene, state: State, explicit: bool) -> tuple[State, Lists | None]:
    """Lists that are due, and the state, which needs no others yet; for `explicit` steps as well, or not."""
    contact, listing = scene.contact, state.listing
    if contact is None or listing is None:
        return state, None
    # What a call stopped for is the caller's to mend; where it is not, this call stops for it again.
    served = (jnp.zeros_like(listing.stale), jnp.zeros_like(listing.needed))
    state = eqx.tree_at(lambda s: (s.listing.stale, s.listing.needed), state, served)
    due, short = jnp.asarray(True), jnp.asarray(False)
    turn = jnp.asarray(jnp.inf, float)
    active = no_active(scene.n_nodes, len(contact.share), contact.near.room) if explicit else None
    lists = Lists(
        contact.candidates, contact.near, listing.candidates, listing.near, due, short, turn, active
    )
    return state, lists


def state_lists(state: State, lists: Lists | None) -> Lists | None:
    """The lists, which must be those of the state."""
    if state.listing is None or lists is None:
        return None
    return lists._replace(wide=state.listing.candidates, close=state.listing.near, due=jnp.asarray(True))


def waits(state: State) -> Array:
    """Whether the state waits for the host: for places in the matrix, or for longer lists."""
    if state.listing is None:
        return jnp.asarray(False)
    return state.listing.stale | jnp.any(state.listing.needed > 0)


def listed(scene: Scene, lists: Lists | None) -> Scene:
    """The scene with what is in the lists."""
    if lists is None:
        return scene
    return with_near(eqx.tree_at(lambda s: s.contact.candidates, scene, lists.candidates), lists.near)


def listed_active(scene: Scene, lists: Lists | None) -> Scene:
    """The same for an explicit step, with what is `active` in it."""
    scene = listed(scene, lists)
    if lists is None or scene.contact is None:
        return scene
    return eqx.tree_at(lambda s: s.contact.active, scene, lists.active, is_leaf=lambda leaf: leaf is None)


def renewed(scene: Scene, state: State, lists: Lists | None) -> tuple[State, Lists | None]:
    """The lists made anew where that is due; the state says whether they fitted."""
    if state.listing is None or lists is None:
        return state, None
    wide, old = lists.wide, lists.candidates

    def search(scene: Scene, wide: Around) -> Candidates:
        assert scene.contact is not None
        return find_candidates(scene.contact, scene.bending.hinges(wide.x).theta, wide)

    other = lists.due & ~old.around.equals(wide)
    lists = lists._replace(candidates=where_needed(other, search, old, scene, wide))
    contact = listed(scene, lists).contact
    assert contact is not None and lists is not None
    near = where_needed(lists.due, find_near, lists.near, contact, lists.close)
    needed = jnp.append(near.needed, lists.candidates.count)
    # A list that is too long for a far step is not worth room: it tells that steps must be shorter.
    full = jnp.any(near.overflow) & ~_far(contact, lists)
    full = full | (lists.candidates.count > lists.candidates.triangles.shape[0])
    state = eqx.tree_at(lambda s: s.listing.needed, state, jnp.where(full, needed, 0))
    turn = sharpest(listed(scene, lists), state.x)
    if lists.active is not None:
        # What is active is a part of the list that was.
        count = jnp.where(lists.due, -1, lists.active.count)
        lists = lists._replace(active=eqx.tree_at(lambda a: a.count, lists.active, count))
    return state, lists._replace(near=near, due=jnp.asarray(False), turn=turn)


def with_active(
    scene: Scene, state: State, lists: Lists, ahead: Array, differs: Array, wanted: Array
) -> tuple[State, Lists]:
    """The lists with what is active on the way to `ahead` (n, 3), or to what `differs` (n,) from that by so
    many m, and for some more explicit steps like that; nothing is looked for where none is `wanted`.

    When it is looked for follows from the state alone.
    """
    contact, listing = listed(scene, lists).contact, state.listing
    assert contact is not None and listing is not None and lists.active is not None
    around = Around(state.x, ACTIVE_SLACK * contact.range + ACTIVE_STEPS * motion(state.x, ahead))
    spare = NEXT_SLACK * contact.range + differs
    due = (state.monitor.steps == 0) | ~listing.active.covers(ahead, spare)
    around = select(due, around, listing.active)
    wanted = wanted & (due | (lists.active.count < 0))
    active = where_needed(wanted, find_active, lists.active, contact, around)
    return eqx.tree_at(lambda s: s.listing.active, state, around), lists._replace(active=active)


def sharpest(scene: Scene, x: Array) -> Array:
    """Largest turn in rad of a fold that the lists leave out at positions `x` (n, 3), or a bound of it below
    `DUE_TURN`; 0 where no sheet avoids itself."""
    if scene.contact is None:
        return jnp.zeros(())
    return scene.contact.sharpest(scene.bending.hinges(x).theta)


def largest_move(
    scene: Scene, lists: Lists | None, x: Array, ahead: Array, known: Array | bool = True
) -> Array:
    """Share of the way to `ahead` (n, 3) that one step may go, less where the way is not `known` from steps
    before: lists for more would hold too much."""
    assert scene.contact is not None and lists is not None
    sigma = scene.contact.range
    free = jnp.maximum(STRIDE * sigma, scene.contact.calm)
    stride = jnp.where(lists.short | (lists.near.pair_count > 0), STRIDE * sigma, free)
    most = jnp.where(known, stride, UNKNOWN * sigma)
    return jnp.minimum(most / jnp.maximum(jnp.max(motion(x, ahead)), 1e-300), 1.0)


def ready_for(
    scene: Scene, state: State, lists: Lists | None, ahead: Array, differs: Array | float = 0.0
) -> tuple[State, Lists, Array]:
    """Whether the lists hold for a step from the state to `ahead` (n, 3), or to what `differs` from that by
    so many m; where not, what is due before.

    All follows from the state alone, also where pairs have no place in the matrix: the state then says so and
    waits for the host. Empty lists do where the sheet meets itself nowhere.
    """
    contact, listing = listed(scene, lists).contact, state.listing
    assert contact is not None and listing is not None and lists is not None
    lists = lists._replace(wide=listing.candidates, close=listing.near)
    moved = motion(state.x, ahead)
    spare = jnp.clip(differs, SLACK * contact.range, MOST_SLACK * contact.range)
    candidates, near = _wide(contact, state.x, moved, spare), _close(contact, state.x, ahead, moved, spare)
    known = _made(lists)
    apart = jax.lax.cond(
        lists.near.pair_count == 0,
        lambda: contact.apart(state.x, ahead, APART_AHEAD),
        lambda: jnp.asarray(False),
    )
    blunt = sharpest(listed(scene, lists), state.x) < DUE_TURN
    wide = known & ~((listing.candidates.covers(ahead, spare) | apart) & blunt)
    # What grew on the way must not decide, or a run would go on otherwise where it is resumed.
    crowded = _far(contact, lists) & jnp.any(lists.near.needed > jnp.asarray(first_room(scene.n_nodes)))
    holds = listing.near.covers(state.x) & listing.near.covers(ahead, spare)
    holds = holds & ~jnp.any(lists.near.overflow) & ~crowded
    loose = jnp.mean(listing.near.reach) > LOOSE * jnp.mean(near.reach)
    close = wide | (known & ~apart & (loose | ~holds))
    stale = known & ~close & ~_have_places(scene, lists)
    listing = Listing(
        candidates=select(wide | stale, candidates, listing.candidates),
        near=select(close | stale, near, listing.near),
        active=select(close | stale, nowhere(scene.n_nodes), listing.active),
        matrix=select(stale, _placed(contact, state.x, moved), listing.matrix),
        stale=stale,
        needed=listing.needed,
    )
    age = jnp.where(stale, NEVER, state.kept.age)
    state = eqx.tree_at(lambda s: (s.listing, s.kept.age), state, (listing, age))
    ready = known & ~close & ~stale
    # A list for a short way may be empty: what made the way short counts until a step was tried.
    short = ~ready & (lists.short | (lists.near.pair_count > 0))
    lists = lists._replace(wide=listing.candidates, close=listing.near, due=~ready & ~stale, short=short)
    return state, lists, ready


def still_ready(scene: Scene, state: State, lists: Lists | None, ahead: Array, differs: Array) -> Array:
    """Whether the lists hold for one more step of the stage from the state, to `ahead` (n, 3) or to what
    `differs` (n,) from that by so many m.

    For the first one they do not: lists for the longer steps of another stage are long.
    """
    contact, listing = listed(scene, lists).contact, state.listing
    assert contact is not None and listing is not None and lists is not None
    lists = lists._replace(wide=listing.candidates, close=listing.near)
    spare = NEXT_SLACK * contact.range + differs
    holds = listing.candidates.covers(ahead, spare) & listing.near.covers(ahead, spare)
    holds = holds & ~jnp.any(lists.near.overflow) & _made(lists)
    return holds & (lists.turn < DUE_TURN) & (state.monitor.steps > 0)


def ready_to_restore(scene: Scene, state: State, lists: Lists | None) -> tuple[Lists, Array]:
    """The same for making the factor of the last tangent again, which changes nothing else."""
    assert scene.contact is not None and lists is not None
    there = Around(state.kept.x, jnp.broadcast_to(SLACK * scene.contact.range, scene.n_nodes))
    lists = lists._replace(wide=there, close=there)
    ready = _made(lists)
    return lists._replace(due=~ready), ready


def _far(contact: Contact, lists: Lists) -> Array:
    """Whether the list of sites is one for a step that is longer than those where something is near."""
    return ~lists.short & (jnp.max(lists.close.reach) > LONGEST * contact.range)


def _have_places(scene: Scene, lists: Lists) -> Array:
    """Whether all pairs have a place in the matrix, where there is one."""
    cross = listed(scene, lists).pattern.contact
    return jnp.asarray(True) if cross is None else cross.placed()


def _made(lists: Lists) -> Array:
    """Whether the lists are those that must be made."""
    return lists.candidates.around.equals(lists.wide) & lists.near.around.equals(lists.close)


def _placed(contact: Contact, x: Array, moved: Array) -> Around:
    """Reach of pairs that get a place in the matrix at positions `x` (n, 3), before steps that move nodes by
    `moved` (n,)."""
    floor = PLACED_REACH * contact.range + PLACED_FEWEST * moved
    reach = PLACED_REACH * contact.range + PLACED_STEPS * moved
    return Around(x, jnp.minimum(reach, jnp.maximum(contact.calm, floor)))


def _wide(contact: Contact, x: Array, moved: Array, spare: Array) -> Around:
    """Reach of candidates at positions `x` (n, 3) before steps that move nodes by `moved` (n,), and `spare`
    m to spare."""
    least = REACH * contact.range + spare
    furthest = jnp.maximum(least + FURTHEST * contact.range, contact.calm)
    return Around(x, jnp.minimum(least + STEPS * moved, jnp.maximum(least + FEWEST * moved, furthest)))


def _close(contact: Contact, x: Array, ahead: Array, moved: Array, spare: Array) -> Around:
    """Motions of the next steps from `x` (n, 3), of which the first one goes to `ahead` and moves nodes by
    `moved` (n,): from the middle of their way, so that both its ends are as near as can be."""
    steps = jnp.clip(WAY * contact.range / jnp.maximum(jnp.max(moved), 1e-300), 1.0, SEVERAL)
    reach = spare + HELD * contact.range + 0.5 * ROOM * steps * moved
    return Around(x + 0.5 * steps * (ahead - x), reach)


def _comes_through(wall: Wall, state: State, beyond: Array) -> Array:
    """Whether some of the nodes `beyond` (n,) a wall after a step were on its near side before."""

    def before() -> Array:
        return jnp.any(beyond & (wall.gap(state.x, state.t) >= 0))

    return jax.lax.cond(jnp.any(beyond), before, lambda: jnp.asarray(False))


def passes(scene: Scene, state: State, x: Array, t: Array, turn: Array) -> Array:
    """Whether a step to positions `x` (n, 3) at time `t`, whose `sharpest` turn is known, would pass
    through a wall or the sheet itself, or leaves the lists behind."""
    through = jnp.asarray(False)
    for wall in scene.walls:
        through = through | _comes_through(wall, state, wall.gap(x, t) < 0)
    contact = scene.contact
    if contact is None:
        return through
    left = ~contact.covers(x, state.x) | (turn > MOST_TURN)
    return through | left | contact.crosses(state.x, x)
