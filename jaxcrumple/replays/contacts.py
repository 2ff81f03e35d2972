"""Contact lists for the replay of recorded steps."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxcrumple._jax.arrays import Flag, NodeVectors
from jaxcrumple.assembly.merged_matrix import Merger
from jaxcrumple.contact.host_broad_phase import Search
from jaxcrumple.contact.lists import (
    CandidatePairs,
    Capacity,
    ContactLists,
    MatrixPairs,
    Reference,
    doubled,
    motion,
    no_pairs,
    nowhere,
    unknown_turns,
)
from jaxcrumple.contact.narrow_phase import find_pairs
from jaxcrumple.scene import Scene, with_lists

# Largest distance in contact ranges of the sheet in a replay from the recorded one.
SLACK = 0.25
# Steps whose positions differ by less, in contact ranges, share one search.
TOGETHER = 0.25
# First capacity of the lists in pairs of triangles.
FEWEST = 256


class StretchLists(eqx.Module):
    """Hold the candidate pairs of triangles for each of g stretches of steps.

    `triangles` (g, c, 2), of which the first `count` (g,) are valid; `folded` (g, w) as in `CandidatePairs`;
    `matrix`: structure of the matrix of a direct solver, arrays (g, ...), or None; `capacity` of the site
    pairs of a step."""

    triangles: Int[Array, "*stretches pairs 2"]
    count: Int[Array, " *stretches"]
    folded: Bool[Array, "*stretches ways"]
    matrix: MatrixPairs | None
    capacity: Capacity = eqx.field(static=True)


def make_lists(
    scene: Scene,
    start: Float[np.ndarray, "nodes 3"],
    x: Float[np.ndarray, "stretches steps nodes 3"],
    explicit: Bool[np.ndarray, "stretches steps"],
    merged: bool,
) -> StretchLists:
    """Build the contact lists of all stretches of steps of a run.

    `start` (n, 3): positions in m at the start; `x` (g, s, n, 3): positions in m at the end of each step;
    `explicit` (g, s): whether a step is explicit, so that it also uses positions between its ends; `merged`:
    whether the solver needs sheet and contact in one matrix."""
    contact = scene.contact
    assert contact is not None and scene.lists is not None
    search = Search(contact, np.asarray(scene.bending.nodes))
    before = np.concatenate([start[None], x.reshape(-1, *start.shape)[:-1]]).reshape(x.shape)
    found = [_met(search, *stretch) for stretch in zip(before, x, explicit, strict=True)]
    room = doubled(FEWEST, max(len(pairs) for pairs, _ in found))
    triangles = np.zeros((len(found), room, 2), np.int32)
    for row, (pairs, _) in zip(triangles, found, strict=True):
        row[: len(pairs)] = pairs
    count, folded = np.array([len(pairs) for pairs, _ in found]), np.stack([ways for _, ways in found])
    matrix = _merged(Merger(scene.pattern, search.faces), [pairs for pairs, _ in found]) if merged else None
    arrays = jnp.asarray(triangles), jnp.asarray(count, int), jnp.asarray(folded)
    return StretchLists(*arrays, matrix, scene.lists.pairs.capacity)


def _met(
    search: Search,
    before: Float[np.ndarray, "steps nodes 3"],
    x: Float[np.ndarray, "steps nodes 3"],
    explicit: Bool[np.ndarray, " steps"],
) -> tuple[Int[np.ndarray, "pairs 2"], Bool[np.ndarray, " ways"]]:
    """Find the candidate pairs of the steps from `before` to `x` (s, n, 3).

    Returns the sorted pairs of triangles (c, 2), and the flags `folded` (w,) as in `CandidatePairs`."""
    n = len(search.faces)
    keys, folded = [np.zeros(0, np.int64)], np.zeros(len(search.fan_triangles), bool)
    start = 0
    while start < len(x):
        moved = np.stack([np.asarray(motion(x[start], end)) for end in x[start:]])
        together = int(np.argmax(np.append(moved.max(axis=1) > TOGETHER * search.sigma, True)))
        skin, behind = SLACK * search.sigma + moved[:together], start + together
        for row, k in zip(skin, range(start, behind), strict=True):
            row += np.asarray(motion(before[k], x[k])) * explicit[k]
        pairs, ways = search.find(x[start], skin.max(axis=0))
        keys.append(pairs[:, 0] * n + pairs[:, 1])
        folded, start = folded | ways, behind
    key = np.unique(np.concatenate(keys))
    return np.stack([key // n, key % n], axis=1), folded


def _merged(merger: Merger, found: list[Int[np.ndarray, "_ 2"]]) -> MatrixPairs:
    """Build the merged matrices of all stretches, with equal capacity."""
    room = FEWEST
    while True:
        merged = [merger.merge(pairs, room) for pairs in found]
        most = max(len(one.keys) for one in merged)
        if most == room:
            return jax.tree.map(lambda *parts: jnp.stack(parts), *merged)
        room = most


def in_stretch(scene: Scene, lists: StretchLists | None) -> Scene:
    """Insert the lists of one stretch in the scene, with an empty list of site pairs."""
    if lists is None:
        return with_lists(scene, None)
    # The run has checked that its steps pass through nothing, so a replay does not use these fold angles.
    unknown, here = unknown_turns(scene.bending.nodes.shape[0]), nowhere(scene.n_nodes)
    candidates = CandidatePairs(here, lists.triangles, lists.count, lists.folded, *unknown)
    pairs = no_pairs(scene.n_nodes, lists.capacity)
    return with_lists(scene, ContactLists(candidates, pairs, matrix=lists.matrix))


def in_step(scene: Scene, old: NodeVectors, new: NodeVectors, between: Flag | bool) -> Scene:
    """Build the site pairs of one step in the scene of its stretch.

    `old`, `new` (n, 3): recorded positions in m at the ends of the step; `between`: whether the step also
    uses positions between them."""
    contact, lists = scene.contact, scene.lists
    if contact is None or lists is None:
        return scene
    skin = SLACK * contact.range + jnp.where(between, motion(old, new), 0.0)
    contact, reference = jax.lax.stop_gradient((contact, Reference(new, skin)))
    candidates = eqx.tree_at(lambda c: c.reference, lists.candidates, reference)
    pairs = find_pairs(contact, candidates, reference, lists.pairs.capacity)
    return with_lists(scene, lists._replace(candidates=candidates, pairs=pairs))
