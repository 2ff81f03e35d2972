"""Rebuild the contact lists during a run, limit the steps to them, and reject steps that would pass through
the sheet or a wall."""

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

# Largest move of a node in one step in ranges, without the mean motion: STRIDE, or UNKNOWN if there are no
# earlier steps to predict it from. If no triangles are near, a known move may go as far as `Contact.calm`.
STRIDE, UNKNOWN = 1.0, 0.25
# A list of site pairs covers up to SEVERAL steps that move nodes by no more than WAY ranges together, times
# the margin ROOM. It is rebuilt if its skin is LOOSE times the one needed now. All lists add the error of the
# predicted step, between SLACK and MOST_SLACK ranges: more would list many neighbours in a flat sheet.
SEVERAL, WAY, ROOM, SLACK, MOST_SLACK, LOOSE = 4.0, 0.25, 1.2, 0.05, 0.25, 2.0
# Further skin of a new list of site pairs in ranges, so that it stays valid after the next step.
HELD = 0.05
# Largest skin of a list of site pairs in ranges if triangles are near; the factor absorbs rounding.
LONGEST = 1.01 * (MOST_SLACK + HELD + 0.5 * ROOM * STRIDE)
# Allowed error of a predicted explicit step in ranges.
NEXT_SLACK = 0.01
# The active set covers this many explicit steps, plus this many ranges.
ACTIVE_STEPS, ACTIVE_SLACK = 16.0, 0.02
# Skin of the candidates: REACH ranges plus STEPS steps like the next one. The steps contribute at most
# FURTHEST ranges, or the skin is at most `Contact.calm` if that is more. FEWEST steps are always covered.
REACH, STEPS, FEWEST, FURTHEST = 0.35, 16.0, 3.0, 2.0
# The same for pairs with entries in the merged matrix, without a limit like FURTHEST: the skin is at most
# `Contact.calm`, with which a flat sheet has no pairs, but covers PLACED_FEWEST steps.
PLACED_REACH, PLACED_FEWEST, PLACED_STEPS = 0.75, 2.0, 32.0


class Lists(NamedTuple):
    """Hold the contact lists in the loop of `integrate`.

    - `candidates`, `near`: the current lists of triangle pairs and of site pairs.
    - `wide`, `close`: the motions that these two must cover after the next rebuild.
    - `due`: whether that rebuild must precede the next step.
    - `short`: whether triangles were near within a longer step, so that the next step must be short.
    - `turn`: `sharpest` in rad at the start of the current round of steps.
    - `active`: active set for the next explicit steps, or None without an explicit stage.
    """

    candidates: Candidates
    near: Near
    wide: Around
    close: Around
    due: Array
    short: Array
    turn: Array
    active: Active | None


def without_places(scene: Scene) -> Scene:
    """Return the scene without its merged matrix, for a solver that does not use one and must not wait for
    the host to build it."""
    if scene.pattern.contact is None or scene.pattern.contact.merged is None:
        return scene
    return eqx.tree_at(lambda s: s.pattern.contact.merged, scene, None)


def start_lists(scene: Scene, state: State, explicit: bool) -> tuple[State, Lists | None]:
    """Return the state without requests to the host, and lists that must be rebuilt before the first step.

    `explicit`: whether the scheme has an explicit stage, which needs an active set.
    """
    contact, listing = scene.contact, state.listing
    if contact is None or listing is None:
        return state, None
    # The caller must have met the requests of the last call. If not, this call stops for them again.
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
    """Return the lists, marked for a rebuild with the motions of the state's listing."""
    if state.listing is None or lists is None:
        return None
    return lists._replace(wide=state.listing.candidates, close=state.listing.near, due=jnp.asarray(True))


def waits(state: State) -> Array:
    """Return whether the state waits for the host: for entries in the merged matrix, or for more capacity."""
    if state.listing is None:
        return jnp.asarray(False)
    return state.listing.stale | jnp.any(state.listing.needed > 0)


def listed(scene: Scene, lists: Lists | None) -> Scene:
    """Return the scene with the current `lists`."""
    if lists is None:
        return scene
    return with_near(eqx.tree_at(lambda s: s.contact.candidates, scene, lists.candidates), lists.near)


def listed_active(scene: Scene, lists: Lists | None) -> Scene:
    """Return the scene with the current `lists` and the active set, for an explicit step."""
    scene = listed(scene, lists)
    if lists is None or scene.contact is None:
        return scene
    return eqx.tree_at(lambda s: s.contact.active, scene, lists.active, is_leaf=lambda leaf: leaf is None)


def renewed(scene: Scene, state: State, lists: Lists | None) -> tuple[State, Lists | None]:
    """Rebuild the lists if they are due; after an overflow, record the required capacities in the state."""
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
    # An overflow for a far step does not ask for capacity: `ready_for` then asks for a short step.
    full = jnp.any(near.overflow) & ~_far(contact, lists)
    full = full | (lists.candidates.count > lists.candidates.triangles.shape[0])
    state = eqx.tree_at(lambda s: s.listing.needed, state, jnp.where(full, needed, 0))
    turn = sharpest(listed(scene, lists), state.x)
    if lists.active is not None:
        # The active set refers to places in the old list.
        count = jnp.where(lists.due, -1, lists.active.count)
        lists = lists._replace(active=eqx.tree_at(lambda a: a.count, lists.active, count))
    return state, lists._replace(near=near, due=jnp.asarray(False), turn=turn)


def with_active(
    scene: Scene, state: State, lists: Lists, ahead: Array, differs: Array, wanted: Array
) -> tuple[State, Lists]:
    """Rebuild the active set if the next explicit step may leave it; return the state and the lists.

    The new set covers `ACTIVE_STEPS` such steps. The decision depends on the state alone.

    **Arguments:** `ahead` (n, 3): predicted positions in m after the step; `differs` (n,): bound on their
    error in m; `wanted`: whether the step is taken; without it, no set is built.
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
    """Return the largest turn in rad of the ways at nodes that the lists leave out, at positions `x` (n, 3).

    If an upper bound is below `DUE_TURN`, the result is that bound; without contact it is 0.
    """
    if scene.contact is None:
        return jnp.zeros(())
    return scene.contact.sharpest(scene.bending.hinges(x).theta)


def largest_move(
    scene: Scene, lists: Lists | None, x: Array, ahead: Array, known: Array | bool = True
) -> Array:
    """Return the share of the path from `x` to `ahead` (n, 3) that one step may take.

    It is less if the path is not `known` from earlier steps. Lists for a longer step would be too long.
    """
    assert scene.contact is not None and lists is not None
    sigma = scene.contact.range
    free = jnp.maximum(STRIDE * sigma, scene.contact.calm)
    stride = jnp.where(lists.short | (lists.near.pair_count > 0), STRIDE * sigma, free)
    most = jnp.where(known, stride, UNKNOWN * sigma)
    return jnp.minimum(most / jnp.maximum(jnp.max(motion(x, ahead)), 1e-300), 1.0)


def ready_for(
    scene: Scene, state: State, lists: Lists | None, ahead: Array, differs: Array | float = 0.0
) -> tuple[State, Lists, Array]:
    """Check whether the lists cover the next step; if not, request what must precede it.

    This is a rebuild of one or both lists, or, if pairs lack entries in the merged matrix, work of the host:
    the state is then `stale` and waits. All decisions depend on the state alone. Where `Contact.apart`
    proves that the sheet has no contact, empty lists suffice.

    **Arguments:** `ahead` (n, 3): predicted positions in m after the step; `differs`: bound on their error in
    m.

    **Returns:** the state, the lists, and whether the step can be taken now.
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
    # Compare with the first capacities. The current ones grow during a run, and a resumed run would decide
    # differently.
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
    # The list for the short step may be empty, so remember why the step is short until it was tried.
    short = ~ready & (lists.short | (lists.near.pair_count > 0))
    lists = lists._replace(wide=listing.candidates, close=listing.near, due=~ready & ~stale, short=short)
    return state, lists, ready


def still_ready(scene: Scene, state: State, lists: Lists | None, ahead: Array, differs: Array) -> Array:
    """Return whether the lists cover one more explicit step.

    It is False for the first step of the stage: the lists of another stage, with longer steps, are too long.

    **Arguments:** `ahead` (n, 3): predicted positions in m after the step; `differs` (n,): bound on their
    error in m.
    """
    contact, listing = listed(scene, lists).contact, state.listing
    assert contact is not None and listing is not None and lists is not None
    lists = lists._replace(wide=listing.candidates, close=listing.near)
    spare = NEXT_SLACK * contact.range + differs
    holds = listing.candidates.covers(ahead, spare) & listing.near.covers(ahead, spare)
    holds = holds & ~jnp.any(lists.near.overflow) & _made(lists)
    return holds & (lists.turn < DUE_TURN) & (state.monitor.steps > 0)


def ready_to_restore(scene: Scene, state: State, lists: Lists | None) -> tuple[Lists, Array]:
    """Check whether the lists are those for recomputing the factor of the lagged tangent, else request them.

    **Returns:** the lists, and whether the factor can be computed now.
    """
    assert scene.contact is not None and lists is not None
    there = Around(state.kept.x, jnp.broadcast_to(SLACK * scene.contact.range, scene.n_nodes))
    lists = lists._replace(wide=there, close=there)
    ready = _made(lists)
    return lists._replace(due=~ready), ready


def _far(contact: Contact, lists: Lists) -> Array:
    """Return whether the list of site pairs is for a step that is longer than steps near contact may be."""
    return ~lists.short & (jnp.max(lists.close.reach) > LONGEST * contact.range)


def _have_places(scene: Scene, lists: Lists) -> Array:
    """Return whether all pairs have entries in the merged matrix; True without such a matrix."""
    cross = listed(scene, lists).pattern.contact
    return jnp.asarray(True) if cross is None else cross.placed()


def _made(lists: Lists) -> Array:
    """Return whether the lists were built for the requested motions."""
    return lists.candidates.around.equals(lists.wide) & lists.near.around.equals(lists.close)


def _placed(contact: Contact, x: Array, moved: Array) -> Around:
    """Return the motions that the merged matrix must cover from positions `x` (n, 3), before steps that move
    nodes by `moved` (n,) in m."""
    floor = PLACED_REACH * contact.range + PLACED_FEWEST * moved
    reach = PLACED_REACH * contact.range + PLACED_STEPS * moved
    return Around(x, jnp.minimum(reach, jnp.maximum(contact.calm, floor)))


def _wide(contact: Contact, x: Array, moved: Array, spare: Array) -> Around:
    """Return the motions that the candidates must cover from positions `x` (n, 3), before steps that move
    nodes by `moved` (n,) in m, with the margin `spare` in m."""
    least = REACH * contact.range + spare
    furthest = jnp.maximum(least + FURTHEST * contact.range, contact.calm)
    return Around(x, jnp.minimum(least + STEPS * moved, jnp.maximum(least + FEWEST * moved, furthest)))


def _close(contact: Contact, x: Array, ahead: Array, moved: Array, spare: Array) -> Around:
    """Return the motions that the site pairs must cover in the next steps from positions `x` (n, 3).

    The first step goes to `ahead` (n, 3) and moves nodes by `moved` (n,) in m; `spare`: margin in m. The list
    is centred halfway along the predicted path, which halves the skin.
    """
    steps = jnp.clip(WAY * contact.range / jnp.maximum(jnp.max(moved), 1e-300), 1.0, SEVERAL)
    reach = spare + HELD * contact.range + 0.5 * ROOM * steps * moved
    return Around(x + 0.5 * steps * (ahead - x), reach)


def _comes_through(wall: Wall, state: State, beyond: Array) -> Array:
    """Return whether some of the nodes `beyond` (n,) a wall after a step were on its near side before."""

    def before() -> Array:
        return jnp.any(beyond & (wall.gap(state.x, state.t) >= 0))

    return jax.lax.cond(jnp.any(beyond), before, lambda: jnp.asarray(False))


def passes(scene: Scene, state: State, x: Array, t: Array, turn: Array) -> Array:
    """Return whether to reject a step to positions `x` (n, 3) at time `t` in s.

    It is rejected if it would pass through a wall or the sheet itself, or leaves the motions that the lists
    cover. `turn`: `sharpest` in rad at `x`.
    """
    through = jnp.asarray(False)
    for wall in scene.walls:
        through = through | _comes_through(wall, state, wall.gap(x, t) < 0)
    contact = scene.contact
    if contact is None:
        return through
    left = ~contact.covers(x, state.x) | (turn > MOST_TURN)
    return through | left | contact.crosses(state.x, x)
