"""Rebuild and enlarge the contact lists on the host: broad phase, and more capacity after an overflow."""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from jaxcrumple._jax.door import door
from jaxcrumple._jax.program_cache import make_room
from jaxcrumple._jax.tree import is_known
from jaxcrumple.assembly.merged_matrix import Merger
from jaxcrumple.contact.adjacency import PLACED_TURN, largest_turn
from jaxcrumple.contact.host_broad_phase import Search
from jaxcrumple.contact.lists import (
    SOON,
    Around,
    Candidates,
    Room,
    doubled,
    first_room,
    no_candidates,
    no_neighbors,
)
from jaxcrumple.contact.narrow_phase import find_near
from jaxcrumple.scene import Scene, require_scene, with_near
from jaxcrumple.state import Listing, State, check_positions, first_listing

_find_near = eqx.filter_jit(find_near)
# First capacity for candidates per node, and its lower limit. In a fine mesh the candidates include the next
# neighbours of all triangles.
CANDIDATES_PER_NODE, LEAST_CANDIDATES = 16, 32_000
# Capacity of the merged matrix in pairs of triangles, relative to that of the lists.
PLACES = 2


class Renewal:
    """Rebuild the contact lists of one run, and hold their capacities.

    **Arguments:** `scene`: with contact; `merged`: whether a direct solver needs the tangent in one matrix.
    """

    def __init__(self, scene: Scene, merged: bool):
        contact = scene.contact
        assert contact is not None and scene.pattern.contact is not None
        self.search = Search(contact, np.asarray(scene.bending.nodes))
        self.merger = Merger(scene.pattern, np.asarray(contact.faces)) if merged else None
        least = max(CANDIDATES_PER_NODE * scene.n_nodes, LEAST_CANDIDATES)
        self.candidates = max(least, contact.candidates.triangles.shape[0])
        first = first_room(scene.n_nodes)
        # All dense crumples soon need this capacity. A smaller one costs them one more compilation, and does
        # not speed up other runs.
        first = first._replace(triangles=2 * first.triangles)
        sizes = zip(first, contact.near.room, strict=True)
        self.room = Room(*(max(own, before) for own, before in sizes))
        self.places = PLACES * self.room.triangles

    def __call__(self, scene: Scene, state: State) -> Scene:
        """Return the scene for the next call of `integrate`, after one that stopped for a list.

        Every new capacity needs a compilation. Lists and merged matrix therefore grow together: when one
        overflows, the others soon would.
        """
        listing = state.listing
        assert listing is not None
        needed = np.asarray(listing.needed)
        if needed.any():
            scene = self.grown(scene, needed)
        if bool(listing.stale) or self._places_of(scene) < self.places:
            scene = self.placed(scene, listing.matrix)
        assert scene.contact is not None
        return scene if scene.contact.near.room == self.room else _with_room(scene, self.room)

    def first(self, scene: Scene, state: State) -> Scene:
        """Return the scene for the first call of `integrate`; for a saved state, rebuild the lists it had."""
        listing = state.listing
        assert listing is not None
        scene = self.placed(scene, listing.matrix, SOON)
        scene = self.searched(_with_room(scene, self.room), listing.candidates)
        assert scene.contact is not None
        return self(self.filled(scene, first_listing(scene.contact, state.x).near), state)

    def filled(self, scene: Scene, around: Around) -> Scene:
        """Return the scene with site pairs for the motions `around`; increase capacities until they fit.

        The narrow phase is a separate program here, because it compiles faster than a run.
        """
        assert scene.contact is not None
        if int(scene.contact.candidates.count) == 0:
            # Without candidates there are no site pairs.
            return with_near(scene, eqx.tree_at(lambda near: near.around, scene.contact.near, around))
        while True:
            assert scene.contact is not None
            near = _find_near(scene.contact, around)
            if not np.any(near.overflow):
                return with_near(scene, near)
            scene = self.grown(scene, np.append(near.needed, 0))

    def grown(self, scene: Scene, needed: np.ndarray) -> Scene:
        """Return the scene with capacities doubled until they hold `SOON` times `needed` (4,).

        The candidates grow only after an overflow.
        """
        make_room("lists", self.room)  # for the program with the new capacities
        sizes = zip(self.room, needed[:3], strict=True)
        self._enlarge(max(doubled(room, int(SOON * much)) // room for room, much in sizes))
        self.places = max(self.places, PLACES * self.room.triangles)
        if needed[3] > self.candidates:
            self.candidates = doubled(self.candidates, int(SOON * needed[3]))
            scene = _with_candidates(scene, self.candidates)
        return _with_room(scene, self.room)

    def searched(self, scene: Scene, around: Around) -> Scene:
        """Return the scene with the candidates for the motions `around`, from the broad phase on the host."""
        pairs, folded = self.search.find(np.asarray(around.x), np.asarray(around.reach))
        self.candidates = doubled(self.candidates, len(pairs))
        triangles = np.zeros((self.candidates, 2), np.int32)
        triangles[: len(pairs)] = pairs
        count = jnp.asarray(len(pairs), int)
        ways = jnp.asarray(folded)
        found = Candidates(jnp.asarray(triangles), count, around, ways, *_turned(scene, around.x, ways))
        return eqx.tree_at(lambda s: s.contact.candidates, scene, found)

    def placed(self, scene: Scene, around: Around, spare: float = 1.0) -> Scene:
        """Return the scene with a merged matrix that has entries for all candidates for the motions `around`.

        Its capacity suffices for `spare` times as many pairs. Without a merged matrix, the scene is returned
        as it is.
        """
        if self.merger is None:
            return scene
        pairs, _ = self.search.find(np.asarray(around.x), np.asarray(around.reach), PLACED_TURN)
        merged = self.merger.merge(pairs, self.places, spare)
        self.places = merged.keys.shape[0]
        self._enlarge(doubled(PLACES * self.room.triangles, self.places) // (PLACES * self.room.triangles))
        return eqx.tree_at(
            lambda s: s.pattern.contact.merged, scene, merged, is_leaf=lambda leaf: leaf is None
        )

    def _enlarge(self, factor: int) -> None:
        self.room = Room(*(factor * size for size in self.room))

    def _places_of(self, scene: Scene) -> float:
        """Return the capacity of the merged matrix in pairs of triangles; infinity if there is none."""
        assert scene.pattern.contact is not None
        merged = scene.pattern.contact.merged
        return np.inf if merged is None else merged.keys.shape[0]


@eqx.filter_jit
def _turned(scene: Scene, x: Array, folded: Array) -> tuple[Array, Array]:
    """Return the hinge angles (h,) in rad at positions `x` (n, 3), and the largest turn in rad of the ways
    that are not `folded` (w,)."""
    assert scene.contact is not None
    theta = scene.bending.hinges(x).theta
    return theta, largest_turn(scene.contact.fans.turning(theta), folded)


def _with_room(scene: Scene, room: Room) -> Scene:
    """Return the scene with empty lists of site pairs of capacities `room`."""
    assert scene.contact is not None
    return with_near(scene, no_neighbors(scene.n_nodes, len(scene.contact.share), room))


def _with_candidates(scene: Scene, size: int) -> Scene:
    """Return the scene with an empty list of candidates of capacity `size`."""
    assert scene.contact is not None
    old = scene.contact.candidates
    none = no_candidates(scene.n_nodes, len(old.theta), len(old.folded), size)
    return eqx.tree_at(lambda s: s.contact.candidates, scene, none)


@door
def with_contacts(scene: Scene, x: ArrayLike | State, needed: ArrayLike | None = None) -> Scene:
    """Build the contact lists of a scene for positions `x` (n, 3) in m, on the host.

    Call it before `energies`, `force` or `tangent` of a scene with contact: away from `x` they return NaN
    rather than a wrong value. `simulate` builds its own lists.

    `integrate`, also under `vmap`, rebuilds the lists as needed. It stops before its end time, with the
    result "success", if a list overflows (`state.listing.needed`) or if the matrix of a direct solver lacks
    entries for a pair (`state.listing.stale`). Continue in both cases with `with_contacts(scene, state)`.

    **Arguments:**

    - `x`: positions, or a `State`, whose lists are then rebuilt.
    - `needed` (4,): required capacities: pairs of triangles, sites near triangles, site pairs, and candidate
      pairs of triangles; by default those of the state. For a batch, pass the maximum over its states.

    **Returns:** the scene with the lists; a scene without contact unchanged.

    **Raises:** ValueError for positions of another shape or not finite, or inside a function that JAX traces.
    """
    require_scene(scene)
    contact = scene.contact
    if contact is None:
        return scene
    listing, positions = (x.listing, x.x) if isinstance(x, State) else (None, x)
    if not is_known(positions, scene.mass):
        raise ValueError("with_contacts needs positions on the host: call it outside jit, grad and vmap.")
    check_positions("x", positions, scene.n_nodes)
    if listing is None:
        listing = first_listing(contact, jnp.asarray(positions, float))
    return _listed(scene, listing, np.asarray(listing.needed if needed is None else needed), merged=True)


def batch_with_contacts(scenes: Sequence[Scene], states: Sequence[State]) -> list[Scene]:
    """Build the contact lists of a batch of scenes for their states, all with the same capacities.

    Scenes without contact are returned unchanged. No merged matrix for a direct solver is built.
    """
    if scenes[0].contact is None:
        return list(scenes)
    listings = [_listing(state) for state in states]
    needed = np.max([np.asarray(listing.needed) for listing in listings], axis=0)
    while True:
        made = [
            _listed(scene, listing, needed, merged=False)
            for scene, listing in zip(scenes, listings, strict=True)
        ]
        sizes = [_sizes(scene) for scene in made]
        if len(set(sizes)) == 1:
            return made
        *room, candidates = np.max(sizes, axis=0).tolist()
        scenes = [_with_candidates(_with_room(scene, Room(*room)), candidates) for scene in made]
        needed = np.zeros_like(needed)


def _listing(state: State) -> Listing:
    assert state.listing is not None
    return state.listing


def _sizes(scene: Scene) -> tuple[int, ...]:
    """Return the capacities of the lists: those of `Room`, and that of the candidates."""
    assert scene.contact is not None
    return (*scene.contact.near.room, scene.contact.candidates.triangles.shape[0])


def _listed(scene: Scene, listing: Listing, needed: np.ndarray, merged: bool) -> Scene:
    """Return the scene with the lists of a state's `listing` and capacities for `needed` (4,)."""
    renewal = Renewal(scene, merged)
    scene = renewal.grown(scene, needed)
    scene = renewal.searched(scene, listing.candidates)
    return renewal.filled(renewal.placed(scene, listing.matrix), listing.near)
