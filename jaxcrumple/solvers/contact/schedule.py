"""Rebuild the contact lists during a run, and limit the steps to them."""

import enum
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp

from jaxcrumple._jax.arrays import Count, Flag, NodeValues, NodeVectors, Scalar
from jaxcrumple._jax.batched_cond import where_needed
from jaxcrumple._jax.tree import select
from jaxcrumple.contact import coverage
from jaxcrumple.contact.active_set import find_active
from jaxcrumple.contact.adjacency import DUE_TURN
from jaxcrumple.contact.broad_phase import find_candidates
from jaxcrumple.contact.lists import (
    CandidatePairs,
    ContactLists,
    Reference,
    first_capacity,
    motion,
    no_active,
    no_candidates,
    no_pairs,
    nowhere,
)
from jaxcrumple.contact.narrow_phase import find_pairs
from jaxcrumple.contact.parameters import Contact
from jaxcrumple.contact.skin import ACTIVE, CANDIDATES, MATRIX, PAIRS
from jaxcrumple.history import NEVER
from jaxcrumple.scene import Scene, with_lists
from jaxcrumple.state import Listing, State

# Largest move of a node in one step in ranges, without the mean motion: STRIDE, or UNKNOWN if there are no
# earlier steps to predict it from. If no triangles are near, a known move may go as far as `Contact.calm`.
STRIDE, UNKNOWN = 1.0, 0.25
# All lists add the error of the predicted step, between SLACK and MOST_SLACK ranges: more would list many
# neighbours in a flat sheet. NEXT_SLACK is the same for one more explicit step.
SLACK, MOST_SLACK, NEXT_SLACK = 0.05, 0.25, 0.01
# Margin of a list of site pairs over the steps that it covers. It is rebuilt if its skin is LOOSE times the
# one needed now.
MARGIN, LOOSE = 1.2, 2.0
# Skin in ranges of a list of site pairs around an iterate, and of the candidates for it.
AROUND, WIDER = 0.4, 0.6
# Largest skin in ranges of a list of site pairs around an iterate that may ask for more capacity. Around an
# iterate further away there may be 30 times as many pairs, and all later steps would carry their arrays.
ASTRAY = 1.5
# Largest skin of a list of site pairs in ranges if triangles are near; the factor absorbs rounding.
LONGEST = 1.01 * (MOST_SLACK + PAIRS.floor + 0.5 * MARGIN * STRIDE)


class ListStatus(enum.IntEnum):
    """Name what must precede the next step, if anything. Statuses from `REBUILD_LISTED` on need a rebuild."""

    READY = 0
    # The host must add entries to the matrix, or give the lists more capacity; the call ends.
    WAIT_MATRIX = 1
    WAIT_CAPACITY = 2
    # The lists are not those that the state names: at the start of a call, or after an attempt elsewhere.
    REBUILD_LISTED = 3
    # The step leaves a skin.
    REBUILD_PAIRS = 4
    REBUILD_CANDIDATES = 5
    # The list of site pairs for so long a step has many entries: rebuild it for a shorter step.
    STEP_TOO_LONG = 6

    @property
    def array(self) -> Count:
        """Return the status as an array that a loop can carry."""
        return jnp.asarray(int(self), int)


class Schedule(NamedTuple):
    """Hold the contact lists in the loop of `integrate`, and what must happen to them.

    - `lists`: the current lists; `active` is None without an explicit stage.
    - `candidates`, `pairs`: the motions that these two lists must cover after the next rebuild.
    - `status`: a `ListStatus`.
    - `short`: whether triangles were near within a longer step, so that the next step must be short.
    - `turn`: `unlisted_turn` in rad at the start of the round of steps, or after the last explicit step.
    - `placed`: whether all pairs have entries in the matrix of a direct solver.
    """

    lists: ContactLists
    candidates: Reference
    pairs: Reference
    status: Count
    short: Flag
    turn: Scalar
    placed: Flag

    @property
    def due(self) -> Flag:
        """Return whether a rebuild must precede the next step."""
        return self.status >= ListStatus.REBUILD_LISTED


def empty_lists(scene: Scene, contact: Contact) -> ContactLists:
    """Return lists of the smallest capacity that cover no positions."""
    hinges, ways = scene.bending.nodes.shape[0], contact.fans.triangles.shape[0]
    return ContactLists(no_candidates(scene.n_nodes, hinges, ways), no_pairs(scene.n_nodes))


def without_matrix(scene: Scene) -> Scene:
    """Return the scene without the matrix of sheet and contact, for a solver that does not use one and must
    not wait for the host to build it."""
    return scene if scene.lists is None else with_lists(scene, scene.lists._replace(matrix=None))


def start_schedule(scene: Scene, state: State, explicit: bool) -> tuple[State, Schedule | None]:
    """Return the state without requests to the host, and lists that must be rebuilt before the first step.

    `explicit`: whether the scheme has an explicit stage, which needs an active set.
    """
    contact, listing = scene.contact, state.listing
    if contact is None or listing is None:
        return state, None
    # The caller must have met the requests of the last call. If not, this call stops for them again.
    served = (jnp.zeros_like(listing.stale), jnp.zeros_like(listing.needed))
    state = eqx.tree_at(lambda s: (s.listing.stale, s.listing.needed), state, served)
    lists = empty_lists(scene, contact) if scene.lists is None else scene.lists
    lists = lists._replace(active=no_active(scene.n_nodes, lists.pairs.capacity) if explicit else None)
    no = jnp.asarray(False)
    return state, Schedule(
        lists=lists,
        candidates=listing.candidates,
        pairs=listing.pairs,
        status=ListStatus.REBUILD_LISTED.array,
        short=no,
        turn=jnp.asarray(jnp.inf, float),
        placed=no,
    )


def rescheduled(state: State, schedule: Schedule | None) -> Schedule | None:
    """Return the schedule with a rebuild for the motions of the state's listing."""
    if state.listing is None or schedule is None:
        return None
    listing = state.listing
    schedule = schedule._replace(candidates=listing.candidates, pairs=listing.pairs)
    return schedule._replace(status=ListStatus.REBUILD_LISTED.array)


def waits(state: State) -> Flag:
    """Return whether the state waits for the host: for entries in the matrix, or for more capacity."""
    if state.listing is None:
        return jnp.asarray(False)
    return state.listing.stale | jnp.any(state.listing.needed > 0)


def listed(scene: Scene, schedule: Schedule | None) -> Scene:
    """Return the scene with the current lists, without the active set."""
    return scene if schedule is None else with_lists(scene, schedule.lists._replace(active=None))


def listed_active(scene: Scene, schedule: Schedule | None) -> Scene:
    """Return the scene with the current lists and the active set, for an explicit step."""
    return scene if schedule is None else with_lists(scene, schedule.lists)


def renewed(scene: Scene, state: State, schedule: Schedule | None) -> tuple[State, Schedule | None]:
    """Rebuild the lists if they are due; after an overflow, record the required capacities in the state."""
    contact = scene.contact
    if contact is None or state.listing is None or schedule is None:
        return state, None
    candidates, pairs, active, _ = schedule.lists
    room, capacity = candidates.triangles.shape[0], pairs.capacity

    def search(scene: Scene, reference: Reference) -> CandidatePairs:
        assert scene.contact is not None
        return find_candidates(scene.contact, scene.bending.hinges(reference.x).half, reference, room)

    other = schedule.due & ~candidates.reference.equals(schedule.candidates)
    candidates = where_needed(other, search, candidates, scene, schedule.candidates)
    search_pairs = partial(find_pairs, capacity=capacity)
    pairs = where_needed(schedule.due, search_pairs, pairs, contact, candidates, schedule.pairs)
    needed = jnp.append(pairs.needed, candidates.count)
    # An overflow for a far step does not ask for capacity: `ready_for` then asks for a short step.
    full = (pairs.overflow & ~_far(contact, schedule)) | candidates.overflow
    state = eqx.tree_at(lambda s: s.listing.needed, state, jnp.where(full, needed, 0))
    turn = coverage.largest_unlisted_turn(contact, candidates, scene.bending.hinges(state.x).half)
    if active is not None:
        # The active set refers to places in the old list.
        count = jnp.where(schedule.due, -1, active.count)
        active = eqx.tree_at(lambda a: a.count, active, count)
    lists = schedule.lists._replace(candidates=candidates, pairs=pairs, active=active)
    blocks = with_lists(scene, lists._replace(active=None)).sparsity
    placed = where_needed(schedule.due, lambda pattern: pattern.placed, schedule.placed, blocks)
    status = jnp.where(full, ListStatus.WAIT_CAPACITY.array, ListStatus.READY.array)
    return state, schedule._replace(lists=lists, status=status, turn=turn, placed=placed)


def with_active(
    scene: Scene, state: State, schedule: Schedule, ahead: NodeVectors, differs: NodeValues, wanted: Flag
) -> tuple[State, Schedule]:
    """Rebuild the active set if the next explicit step may leave it; return the state and the schedule.

    The new set covers `ACTIVE_STEPS` such steps. The decision depends on the state alone.

    **Arguments:** `ahead` (n, 3): predicted positions in m after the step; `differs` (n,): bound on their
    error in m; `wanted`: whether the step is taken; without it, no set is built.
    """
    contact, listing, lists = scene.contact, state.listing, schedule.lists
    assert contact is not None and listing is not None and lists.active is not None
    skin = ACTIVE.skin(contact, motion(state.x, ahead))
    margin = NEXT_SLACK * contact.range + differs
    due = (state.monitor.steps == 0) | ~listing.active.covers(ahead, margin)
    reference = select(due, Reference(state.x, skin), listing.active)
    wanted = wanted & (due | (lists.active.count < 0))

    active = where_needed(wanted, find_active, lists.active, contact, lists, reference)
    state = eqx.tree_at(lambda s: s.listing.active, state, reference)
    return state, schedule._replace(lists=lists._replace(active=active))


def largest_move(
    scene: Scene, schedule: Schedule | None, x: NodeVectors, ahead: NodeVectors, known: Flag | bool = True
) -> Scalar:
    """Return the share of the path from `x` to `ahead` (n, 3) that one step may take.

    It is less if the path is not `known` from earlier steps. Lists for a longer step would be too long.
    """
    assert scene.contact is not None and schedule is not None
    sigma = scene.contact.range
    free = jnp.maximum(STRIDE * sigma, scene.contact.calm)
    near = schedule.short | (schedule.lists.pairs.triangle_count > 0)
    most = jnp.where(known, jnp.where(near, STRIDE * sigma, free), UNKNOWN * sigma)
    return jnp.minimum(most / jnp.maximum(jnp.max(motion(x, ahead)), 1e-300), 1.0)


def ready_for(
    scene: Scene, state: State, schedule: Schedule | None, ahead: NodeVectors, differs: Scalar | float = 0.0
) -> tuple[State, Schedule, Flag]:
    """Check whether the lists cover the next step; if not, request what must precede it.

    This is a rebuild of one or both lists, or, if pairs lack entries in the matrix, work of the host: the
    state is then `stale` and waits. All decisions depend on the state alone.

    **Arguments:** `ahead` (n, 3): predicted positions in m after the step; `differs`: bound on their error in
    m.

    **Returns:** the state, the schedule, and whether the step can be taken now.
    """
    contact, listing = scene.contact, state.listing
    assert contact is not None and listing is not None and schedule is not None
    schedule = schedule._replace(candidates=listing.candidates, pairs=listing.pairs)
    moved = motion(state.x, ahead)
    margin = jnp.clip(differs, SLACK * contact.range, MOST_SLACK * contact.range)
    pairs = _pair_reference(contact, state.x, ahead, moved, margin)
    loose = jnp.mean(listing.pairs.skin) > LOOSE * jnp.mean(pairs.skin)
    status = _status(scene, state, schedule, ahead, margin, loose)
    stale = status == ListStatus.WAIT_MATRIX
    new_candidates = stale | (status == ListStatus.REBUILD_CANDIDATES)
    new_pairs = (status != ListStatus.READY) & (status != ListStatus.REBUILD_LISTED)
    candidates = Reference(state.x, CANDIDATES.skin(contact, moved, margin))
    listing = Listing(
        candidates=select(new_candidates, candidates, listing.candidates),
        pairs=select(new_pairs, pairs, listing.pairs),
        active=select(new_pairs, nowhere(scene.n_nodes), listing.active),
        matrix=select(stale, Reference(state.x, MATRIX.skin(contact, moved)), listing.matrix),
        stale=stale,
        needed=listing.needed,
    )
    age = jnp.where(stale, NEVER, state.kept.age)
    state = eqx.tree_at(lambda s: (s.listing, s.kept.age), state, (listing, age))
    ready = status == ListStatus.READY
    # The list for the short step may be empty, so remember why the step is short until it was tried.
    short = ~ready & (schedule.short | (schedule.lists.pairs.triangle_count > 0))
    schedule = schedule._replace(candidates=listing.candidates, pairs=listing.pairs)
    return state, schedule._replace(status=status, short=short), ready


def around(scene: Scene, state: State, schedule: Schedule, x: NodeVectors) -> tuple[State, Schedule]:
    """Request lists for an iterate `x` (n, 3) that the present ones do not cover.

    They also cover the start of the step, for the test of collisions on the way."""
    contact, listing = scene.contact, state.listing
    assert contact is not None and listing is not None
    moved, sigma = motion(state.x, x), contact.range
    pairs = Reference(state.x + 0.5 * (x - state.x), 0.5 * moved + AROUND * sigma)
    candidates = Reference(state.x, moved + WIDER * sigma)
    enough = listing.candidates.covers(pairs.x, pairs.skin)
    candidates = select(enough, listing.candidates, candidates)
    listing = eqx.tree_at(
        lambda made: (made.candidates, made.pairs, made.active),
        listing,
        (candidates, pairs, nowhere(scene.n_nodes)),
    )
    # A list with too many entries asks for more capacity then, and not for a shorter step, unless the iterate
    # is astray.
    short, status = jnp.max(pairs.skin) <= ASTRAY * sigma, ListStatus.REBUILD_PAIRS.array
    schedule = schedule._replace(candidates=candidates, pairs=pairs, short=short, status=status)
    return eqx.tree_at(lambda s: s.listing, state, listing), schedule


def _status(
    scene: Scene, state: State, schedule: Schedule, ahead: NodeVectors, margin: Scalar, loose: Flag
) -> Count:
    """Return what must precede a step from the state to `ahead` (n, 3) with the `margin` in m, as
    `ListStatus`; `loose`: whether the skin of the site pairs is much larger than needed."""
    contact, listing, lists = scene.contact, state.listing, schedule.lists
    assert contact is not None and listing is not None
    candidates_cover = listing.candidates.covers(ahead, margin) & (schedule.turn < DUE_TURN)
    too_many = crowded(scene, schedule)
    pairs_cover = listing.pairs.covers(state.x) & listing.pairs.covers(ahead, margin)
    pairs_cover = pairs_cover & ~lists.pairs.overflow & ~loose
    reasons = {
        ListStatus.REBUILD_LISTED: ~_made(schedule),
        ListStatus.REBUILD_CANDIDATES: ~candidates_cover,
        ListStatus.STEP_TOO_LONG: too_many,
        ListStatus.REBUILD_PAIRS: ~pairs_cover,
        ListStatus.WAIT_MATRIX: ~schedule.placed,
    }
    return jnp.select(list(reasons.values()), [status.array for status in reasons], ListStatus.READY.array)


def still_ready(
    scene: Scene, state: State, schedule: Schedule | None, ahead: NodeVectors, differs: NodeValues
) -> Flag:
    """Return whether the lists cover one more explicit step.

    It is False for the first step of the stage: the lists of another stage, with longer steps, are too long.

    **Arguments:** `ahead` (n, 3): predicted positions in m after the step; `differs` (n,): bound on their
    error in m.
    """
    contact, listing = scene.contact, state.listing
    assert contact is not None and listing is not None and schedule is not None
    schedule = schedule._replace(candidates=listing.candidates, pairs=listing.pairs)
    margin = NEXT_SLACK * contact.range + differs
    holds = listing.candidates.covers(ahead, margin) & listing.pairs.covers(ahead, margin)
    holds = holds & ~schedule.lists.pairs.overflow & ~crowded(scene, schedule) & _made(schedule)
    return holds & (schedule.turn < DUE_TURN) & (state.monitor.steps > 0)


def ready_to_restore(scene: Scene, state: State, schedule: Schedule | None) -> tuple[Schedule, Flag]:
    """Check whether the lists are those for recomputing the factor of the lagged tangent, else request them.

    **Returns:** the schedule, and whether the factor can be computed now.
    """
    assert scene.contact is not None and schedule is not None
    there = Reference(state.kept.x, jnp.broadcast_to(SLACK * scene.contact.range, scene.n_nodes))
    schedule = schedule._replace(candidates=there, pairs=there)
    ready = _made(schedule)
    status = jnp.where(ready, ListStatus.READY.array, ListStatus.REBUILD_LISTED.array)
    return schedule._replace(status=status), ready


def _far(contact: Contact, schedule: Schedule) -> Flag:
    """Return whether the list of site pairs is for a step that is longer than steps near contact may be."""
    return ~schedule.short & (jnp.max(schedule.pairs.skin) > LONGEST * contact.range)


def crowded(scene: Scene, schedule: Schedule) -> Flag:
    """Return whether the list of site pairs for so long a step, or around an iterate so far away, has so many
    entries that a shorter step is better."""
    # Compare with the first capacities. The current ones grow during a run, and a resumed run would decide
    # differently.
    assert scene.contact is not None
    first = jnp.asarray(first_capacity(scene.n_nodes))
    return _far(scene.contact, schedule) & jnp.any(schedule.lists.pairs.needed > first)


def _made(schedule: Schedule) -> Flag:
    """Return whether the lists were built for the requested motions."""
    lists = schedule.lists
    made = lists.candidates.reference.equals(schedule.candidates)
    return made & lists.pairs.reference.equals(schedule.pairs)


def _pair_reference(
    contact: Contact, x: NodeVectors, ahead: NodeVectors, moved: NodeValues, margin: Scalar
) -> Reference:
    """Return the motions that the site pairs must cover in the next steps from positions `x` (n, 3).

    The first step goes to `ahead` (n, 3) and moves nodes by `moved` (n,) in m; `margin` in m. The list is
    centred halfway along the predicted path, which halves the skin.
    """
    steps = PAIRS.steps_ahead(contact, moved)
    skin = margin + PAIRS.floor * contact.range + 0.5 * MARGIN * steps * moved
    return Reference(x + 0.5 * steps * (ahead - x), skin)
