"""Rebuild and enlarge the contact lists on the host: broad phase, and more capacity after an overflow."""

from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Int

from jaxcrumple._jax.arrays import NodeVectors, NodeVectorsLike, Scalar
from jaxcrumple._jax.door import door
from jaxcrumple._jax.program_cache import make_room
from jaxcrumple._jax.stored_programs import StoredJit, forget_programs
from jaxcrumple._jax.tree import as_array, is_known
from jaxcrumple.assembly.merged_matrix import Merger
from jaxcrumple.contact.adjacency import PLACED_TURN, largest_turn
from jaxcrumple.contact.host_broad_phase import Search
from jaxcrumple.contact.lists import (
    SOON,
    CandidatePairs,
    Capacity,
    ContactLists,
    Reference,
    doubled,
    first_capacity,
    no_candidates,
    no_pairs,
)
from jaxcrumple.contact.narrow_phase import find_pairs
from jaxcrumple.geometry.hinge import HalfAngle
from jaxcrumple.scene import Scene, require_scene, with_lists
from jaxcrumple.solvers.contact.schedule import empty_lists
from jaxcrumple.state import Listing, State, check_positions, first_listing

_find_pairs, _no_pairs, _empty_lists = StoredJit(find_pairs), StoredJit(no_pairs), StoredJit(empty_lists)
_first_listing = StoredJit(first_listing)
# First capacity for candidates per node, and its lower limit. In a fine mesh the candidates include the next
# neighbours of all triangles.
CANDIDATES_PER_NODE, LEAST_CANDIDATES = 16, 32_000
# Capacity of the matrix in pairs of triangles, relative to that of the lists.
PLACES = 2


class Reallocation:
    """Rebuild the contact lists of one run on the host, and hold their capacities.

    **Arguments:** `scene`: with contact; `merged`: whether a direct solver needs the tangent in one matrix.
    """

    def __init__(self, scene: Scene, merged: bool):
        contact = scene.contact
        assert contact is not None
        self.contact = contact
        self.search = Search(contact, np.asarray(scene.bending.nodes))
        self.merger = Merger(scene.pattern, np.asarray(contact.faces)) if merged else None
        before = _lists(scene)
        least = max(CANDIDATES_PER_NODE * scene.n_nodes, LEAST_CANDIDATES)
        self.candidates = max(least, before.candidates.triangles.shape[0])
        first = first_capacity(scene.n_nodes)
        # All dense crumples soon need this capacity. A smaller one costs them one more compilation, and does
        # not speed up other runs.
        first = first._replace(triangles=2 * first.triangles)
        sizes = zip(first, before.pairs.capacity, strict=True)
        self.capacity = Capacity(*(max(own, before) for own, before in sizes))
        self.places = PLACES * self.capacity.triangles

    def __call__(self, scene: Scene, state: State) -> Scene:
        """Return the scene for the next call of `integrate`, after one that stopped for a list.

        Every new capacity needs a compilation. Lists and matrix therefore grow together: when one overflows,
        the others soon would.
        """
        listing, lists = state.listing, _lists(scene)
        assert listing is not None
        if self.overflows(state):
            lists = self.grown(lists, np.asarray(listing.needed))
            # The programs with the old capacities take as much memory as the new ones, and can be read again.
            forget_programs()
        if bool(listing.stale) or _places_of(lists) < self.places:
            lists = self.placed(lists, listing.matrix)
        fits = lists.pairs.capacity == self.capacity
        return with_lists(scene, lists if fits else self._emptied(lists))

    @staticmethod
    def overflows(state: State) -> bool:
        """Return whether a list overflowed, so that the next call of `integrate` needs a compilation."""
        return state.listing is not None and bool(np.any(np.asarray(state.listing.needed)))

    def first(self, scene: Scene, state: State) -> Scene:
        """Return the scene for the first call of `integrate`; for a saved state, rebuild the lists it had."""
        listing = state.listing
        assert listing is not None
        lists = self._emptied(self.placed(_lists(scene), listing.matrix, SOON))
        lists = self.searched(scene, lists, listing.candidates)
        lists = self.filled(lists, _first_listing(self.contact, state.x).pairs)
        return self(with_lists(scene, lists), state)

    def filled(self, lists: ContactLists, reference: Reference) -> ContactLists:
        """Return the lists with site pairs for the motions `reference`; increase capacities until they fit.

        The narrow phase is a separate program here, because it compiles faster than a run.
        """
        if int(lists.candidates.count) == 0:
            # Without candidates there are no site pairs.
            return lists._replace(pairs=eqx.tree_at(lambda pairs: pairs.reference, lists.pairs, reference))
        while True:
            pairs = _find_pairs(self.contact, lists.candidates, reference, lists.pairs.capacity)
            needed = np.asarray(pairs.needed)
            if np.all(needed <= np.array(pairs.capacity)):
                return lists._replace(pairs=pairs)
            lists = self.grown(lists, np.append(needed, 0))

    def grown(self, lists: ContactLists, needed: Int[np.ndarray, "4"]) -> ContactLists:
        """Return the lists with capacities doubled until they hold `SOON` times `needed` (4,).

        The candidates grow only after an overflow.
        """
        make_room("lists", self.capacity)  # for the program with the new capacities
        sizes = zip(self.capacity, needed[:3], strict=True)
        self._enlarge(max(doubled(size, int(SOON * much)) // size for size, much in sizes))
        self.places = max(self.places, PLACES * self.capacity.triangles)
        if needed[3] > self.candidates:
            self.candidates = doubled(self.candidates, int(SOON * needed[3]))
            lists = _with_candidates(lists, self.candidates)
        return self._emptied(lists)

    def searched(self, scene: Scene, lists: ContactLists, reference: Reference) -> ContactLists:
        """Return the lists with the candidates for the motions `reference`, from the host's broad phase."""
        pairs, folded = self.search.find(np.asarray(reference.x), np.asarray(reference.skin))
        self.candidates = doubled(self.candidates, len(pairs))
        triangles = np.zeros((self.candidates, 2), np.int32)
        triangles[: len(pairs)] = pairs
        count, ways = as_array(np.int64(len(pairs))), as_array(folded)
        turned = _turned(scene, reference.x, ways)
        return lists._replace(candidates=CandidatePairs(reference, as_array(triangles), count, ways, *turned))

    def placed(self, lists: ContactLists, reference: Reference, spare: float = 1.0) -> ContactLists:
        """Return the lists with a matrix that has entries for all candidates for the motions `reference`.

        Its capacity suffices for `spare` times as many pairs. For a solver that needs no such matrix, the
        lists are returned as they are.
        """
        if self.merger is None:
            return lists
        pairs, _ = self.search.find(np.asarray(reference.x), np.asarray(reference.skin), PLACED_TURN)
        matrix = self.merger.merge(pairs, self.places, spare)
        self.places = matrix.keys.shape[0]
        own = PLACES * self.capacity.triangles
        self._enlarge(doubled(own, self.places) // own)
        return lists._replace(matrix=matrix)

    def _emptied(self, lists: ContactLists) -> ContactLists:
        """Return the lists without site pairs, with the present capacities."""
        return lists._replace(pairs=_no_pairs(len(self.contact.rest), self.capacity))

    def _enlarge(self, factor: int) -> None:
        self.capacity = Capacity(*(factor * size for size in self.capacity))


def _lists(scene: Scene) -> ContactLists:
    """Return the lists of a scene with contact, by default empty ones."""
    assert scene.contact is not None
    return _empty_lists(scene, scene.contact) if scene.lists is None else scene.lists


def _places_of(lists: ContactLists) -> float:
    """Return the capacity of the matrix in pairs of triangles; infinity if there is none."""
    return np.inf if lists.matrix is None else lists.matrix.keys.shape[0]


@StoredJit
def _turned(scene: Scene, x: NodeVectors, folded: Bool[Array, " ways"]) -> tuple[HalfAngle, Scalar]:
    """Return the halves of the hinge angles (h,) at positions `x` (n, 3), and the largest turn in rad of the
    ways that are not `folded` (w,)."""
    assert scene.contact is not None
    half = scene.bending.hinges(x).half
    return half, largest_turn(scene.contact.fans.turning(half.angle), folded)


def _with_candidates(lists: ContactLists, size: int) -> ContactLists:
    """Return the lists with an empty list of candidates of capacity `size`."""
    old = lists.candidates
    nodes = old.reference.x.shape[0]
    return lists._replace(candidates=no_candidates(nodes, len(old.half.sine), len(old.folded), size))


@door
def with_contacts(
    scene: Scene, x: NodeVectorsLike | State, needed: Int[ArrayLike, "4"] | None = None
) -> Scene:
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
        listing = _first_listing(contact, as_array(positions, float))
    return _listed(scene, listing, np.asarray(listing.needed if needed is None else needed), merged=True)


def batch_with_contacts(scenes: Sequence[Scene], states: Sequence[State]) -> list[Scene]:
    """Build the contact lists of a batch of scenes for their states, all with the same capacities.

    Scenes without contact are returned unchanged. No matrix for a direct solver is built.
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
        *capacity, candidates = np.max(sizes, axis=0).tolist()
        scenes = [_with_sizes(scene, Capacity(*capacity), candidates) for scene in made]
        needed = np.zeros_like(needed)


def joined_with_contacts(scene: Scene, state: State, like: Scene) -> Scene:
    """Build the contact lists of a scene that joins a batch, with at least the capacities of `like`.

    A scene without contact is returned unchanged.
    """
    if scene.contact is None:
        return scene
    *capacity, candidates = _sizes(like)
    scene = _with_sizes(scene, Capacity(*capacity), candidates)
    return _listed(scene, _listing(state), np.zeros(4, int), merged=False)


def _listing(state: State) -> Listing:
    assert state.listing is not None
    return state.listing


def _sizes(scene: Scene) -> tuple[int, ...]:
    """Return the capacities of the lists: those of `Capacity`, and that of the candidates."""
    lists = _lists(scene)
    return (*lists.pairs.capacity, lists.candidates.triangles.shape[0])


def _with_sizes(scene: Scene, capacity: Capacity, candidates: int) -> Scene:
    """Return the scene with empty lists of the given capacities."""
    lists = _with_candidates(_lists(scene), candidates)
    return with_lists(scene, lists._replace(pairs=_no_pairs(scene.n_nodes, capacity)))


def _listed(scene: Scene, listing: Listing, needed: Int[np.ndarray, "4"], merged: bool) -> Scene:
    """Return the scene with the lists of a state's `listing` and capacities for `needed` (4,)."""
    own = Reallocation(scene, merged)
    lists = own.grown(_lists(scene), needed)
    lists = own.searched(scene, lists, listing.candidates)
    return with_lists(scene, own.filled(own.placed(lists, listing.matrix), listing.pairs))
