"""Renewing the lists of contact on the host: the search for candidates, and room for more where lists are
full."""

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
# First room for candidates by node, and at least: in a fine mesh the next neighbours of all triangles are
# among them.
CANDIDATES_PER_NODE, LEAST_CANDIDATES = 16, 32_000
# Pairs of triangles with places in the matrix, for each one that there is room for in the lists.
PLACES = 2


class Renewal:
    """The lists of contact of one run.

    **Arguments:** `scene` with contact; `merged`: whether a direct solver needs the tangent in one matrix.
    """

    def __init__(self, scene: Scene, merged: bool):
        contact = scene.contact
        assert contact is not None and scene.pattern.contact is not None
        self.search = Search(contact, np.asarray(scene.bending.nodes))
        self.merger = Merger(scene.pattern, np.asarray(contact.faces)) if merged else None
        least = max(CANDIDATES_PER_NODE * scene.n_nodes, LEAST_CANDIDATES)
        self.candidates = max(least, contact.candidates.triangles.shape[0])
        first = first_room(scene.n_nodes)
        # What all dense crumples soon need: without it they compile once more, and others gain nothing.
        first = first._replace(triangles=2 * first.triangles)
        sizes = zip(first, contact.near.room, strict=True)
        self.room = Room(*(max(own, before) for own, before in sizes))
        self.places = PLACES * self.room.triangles

    def __call__(self, scene: Scene, state: State) -> Scene:
        """The scene for the next call of `integrate`, where the last one stopped for a list.

        What is longer takes another program. So lists and places grow together, for where one is full the
        others soon are.
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
        """The scene for the first call of `integrate`: a saved state finds the lists it had."""
        listing = state.listing
        assert listing is not None
        scene = self.placed(scene, listing.matrix, SOON)
        scene = self.searched(_with_room(scene, self.room), listing.candidates)
        assert scene.contact is not None
        return self(self.filled(scene, first_listing(scene.contact, state.x).near), state)

    def filled(self, scene: Scene, around: Around) -> Scene:
        """The scene with lists for motions, grown until they fit: an own program that compiles faster than a
        run does."""
        assert scene.contact is not None
        if int(scene.contact.candidates.count) == 0:
            # Nobody to look for.
            return with_near(scene, eqx.tree_at(lambda near: near.around, scene.contact.near, around))
        while True:
            assert scene.contact is not None
            near = _find_near(scene.contact, around)
            if not np.any(near.overflow):
                return with_near(scene, near)
            scene = self.grown(scene, np.append(near.needed, 0))

    def grown(self, scene: Scene, needed: np.ndarray) -> Scene:
        """The scene with room for `needed` (4,), doubled until that fits, or would soon be too small."""
        make_room("lists", self.room)  # for the program that takes the longer lists
        sizes = zip(self.room, needed[:3], strict=True)
        self._enlarge(max(doubled(room, int(SOON * much)) // room for room, much in sizes))
        self.places = max(self.places, PLACES * self.room.triangles)
        if needed[3] > self.candidates:
            self.candidates = doubled(self.candidates, int(SOON * needed[3]))
            scene = _with_candidates(scene, self.candidates)
        return _with_room(scene, self.room)

    def searched(self, scene: Scene, around: Around) -> Scene:
        """The scene with candidates for motions."""
        pairs, folded = self.search.find(np.asarray(around.x), np.asarray(around.reach))
        self.candidates = doubled(self.candidates, len(pairs))
        triangles = np.zeros((self.candidates, 2), np.int32)
        triangles[: len(pairs)] = pairs
        count = jnp.asarray(len(pairs), int)
        ways = jnp.asarray(folded)
        found = Candidates(jnp.asarray(triangles), count, around, ways, *_turned(scene, around.x, ways))
        return eqx.tree_at(lambda s: s.contact.candidates, scene, found)

    def placed(self, scene: Scene, around: Around, spare: float = 1.0) -> Scene:
        """The scene with places in the matrix for all pairs that may meet by motions, if it needs them, and
        for `spare` times as many."""
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
        """Pairs of triangles that have room in the scene's matrix, if it needs any."""
        assert scene.pattern.contact is not None
        merged = scene.pattern.contact.merged
        return np.inf if merged is None else merged.keys.shape[0]


@eqx.filter_jit
def _turned(scene: Scene, x: Array, folded: Array) -> tuple[Array, Array]:
    """Angles (h,) of the hinges at positions `x` (n, 3), and the largest turn of those not `folded` (w,)."""
    assert scene.contact is not None
    theta = scene.bending.hinges(x).theta
    return theta, largest_turn(scene.contact.fans.turning(theta), folded)


def _with_room(scene: Scene, room: Room) -> Scene:
    """The scene with empty lists of other sizes."""
    assert scene.contact is not None
    return with_near(scene, no_neighbors(scene.n_nodes, len(scene.contact.share), room))


def _with_candidates(scene: Scene, size: int) -> Scene:
    """The scene with an empty list of candidates of another size."""
    assert scene.contact is not None
    old = scene.contact.candidates
    none = no_candidates(scene.n_nodes, len(old.theta), len(old.folded), size)
    return eqx.tree_at(lambda s: s.contact.candidates, scene, none)


@door
def with_contacts(scene: Scene, x: ArrayLike | State, needed: ArrayLike | None = None) -> Scene:
    """The scene with its lists of contact made for positions `x` (n, 3) in m, on the host.

    Energies, forces and tangents of a self-avoiding scene hold near the positions that its lists were made
    for, and are NaN elsewhere; `simulate` makes its own. `integrate`, also under `vmap`, makes new ones on
    its way, and stops, with the result "success" before its end time, where they grow longer than these
    (`state.listing.needed`) or where a direct solver's matrix lacks a place (`state.listing.stale`). Both are
    mended by `with_contacts(scene, state)`. A scene without contact is returned as it is.

    **Arguments:**

    - `x`: positions, or a `State`, whose lists are then made.
    - `needed` (4,): pairs of triangles, sites and pairs of sites that are near, and pairs of triangles that
      may meet, for which there must be room; by default what the state needs. A batch needs the largest
      numbers of its states.

    **Raises:** ValueError for positions of another shape or not finite, or inside a function that JAX traces.
    """
    require_scene(scene)
    contact = scene.contact
    if contact is None:
        return scene
    listing, positions = (x.listing, x.x) if isinstance(x, State) else (None, x)
    if not is_known(positions, scene.mass):
        raise ValueError("with_contacts looks at positions on the host: call it outside jit, grad and vmap.")
    check_positions("x", positions, scene.n_nodes)
    if listing is None:
        listing = first_listing(contact, jnp.asarray(positions, float))
    return _listed(scene, listing, np.asarray(listing.needed if needed is None else needed), merged=True)


def batch_with_contacts(scenes: Sequence[Scene], states: Sequence[State]) -> list[Scene]:
    """The scenes of a batch with lists of contact made for their states, all of one size.

    Scenes without contact are returned as they are. Tangents for a direct solver get no places.
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
    """Sizes of the lists: those of `Room`, and candidates."""
    assert scene.contact is not None
    return (*scene.contact.near.room, scene.contact.candidates.triangles.shape[0])


def _listed(scene: Scene, listing: Listing, needed: np.ndarray, merged: bool) -> Scene:
    """The scene with lists for a state's `listing` and room for `needed` (4,)."""
    renewal = Renewal(scene, merged)
    scene = renewal.grown(scene, needed)
    scene = renewal.searched(scene, listing.candidates)
    return renewal.filled(renewal.placed(scene, listing.matrix), listing.near)
