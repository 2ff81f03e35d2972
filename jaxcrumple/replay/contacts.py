"""Contact lists for the replay of recorded steps."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxcrumple.assembly.contact_blocks import Merged
from jaxcrumple.assembly.merged_matrix import Merger
from jaxcrumple.contact.host_broad_phase import Search
from jaxcrumple.contact.lists import Around, Candidates, Near, doubled, motion
from jaxcrumple.contact.narrow_phase import find_near
from jaxcrumple.scene import Scene, with_near

# Largest distance in contact ranges of the sheet in a replay from the recorded one.
SLACK = 0.25
# Steps whose positions differ by less, in contact ranges, share one search.
TOGETHER = 0.25
# First capacity of the lists in pairs of triangles.
FEWEST = 256


class Lists(eqx.Module):
    """Hold the candidate pairs of triangles for each of g stretches of steps.

    `triangles` (g, c, 2), of which the first `count` (g,) are valid; `folded` (g, w) as in `Candidates`;
    `merged`: structure of the merged matrix of a direct solver, arrays (g, ...), or None."""

    triangles: Array
    count: Array
    folded: Array
    merged: Merged | None


def make_lists(scene: Scene, start: np.ndarray, x: np.ndarray, explicit: np.ndarray, merged: bool) -> Lists:
    """Build the contact lists of all stretches of steps of a run.

    `start` (n, 3): positions in m at the start; `x` (g, s, n, 3): positions in m at the end of each step;
    `explicit` (g, s): whether a step is explicit, so that it also uses positions between its ends; `merged`:
    whether the solver needs the merged matrix."""
    contact = scene.contact
    assert contact is not None
    search = Search(contact, np.asarray(scene.bending.nodes))
    before = np.concatenate([start[None], x.reshape(-1, *start.shape)[:-1]]).reshape(x.shape)
    found = [_met(scene, search, *stretch) for stretch in zip(before, x, explicit, strict=True)]
    room = doubled(FEWEST, max(len(pairs) for pairs, _ in found))
    triangles = np.zeros((len(found), room, 2), np.int32)
    for row, (pairs, _) in zip(triangles, found, strict=True):
        row[: len(pairs)] = pairs
    count, folded = np.array([len(pairs) for pairs, _ in found]), np.stack([ways for _, ways in found])
    places = _merged(Merger(scene.pattern, search.faces), [pairs for pairs, _ in found]) if merged else None
    return Lists(jnp.asarray(triangles), jnp.asarray(count, int), jnp.asarray(folded), places)


def _met(
    scene: Scene, search: Search, before: np.ndarray, x: np.ndarray, explicit: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Find the candidate pairs of the steps from `before` to `x` (s, n, 3).

    Returns the sorted pairs of triangles (c, 2), and the flags `folded` (w,) as in `Candidates`."""
    contact, n = scene.contact, len(search.faces)
    assert contact is not None
    keys, folded = [np.zeros(0, np.int64)], np.zeros(len(search.fan_triangles), bool)
    left = [k for k in range(len(x)) if not _apart(contact, before[k], x[k])]
    while left:
        first = x[left[0]]
        moved = np.stack([np.asarray(motion(first, x[k])) for k in left])
        together = int(np.argmax(np.append(moved.max(axis=1) > TOGETHER * search.sigma, True)))
        reach = SLACK * search.sigma + moved[:together]
        for row, k in enumerate(left[:together]):
            reach[row] += np.asarray(motion(before[k], x[k])) * explicit[k]
        pairs, ways = search.find(first, reach.max(axis=0))
        keys.append(pairs[:, 0] * n + pairs[:, 1])
        folded, left = folded | ways, left[together:]
    key = np.unique(np.concatenate(keys))
    return np.stack([key // n, key % n], axis=1), folded


@eqx.filter_jit
def _apart(contact, start: Array, end: Array) -> Array:
    return contact.apart(start, end)


def _merged(merger: Merger, found: list[np.ndarray]) -> Merged:
    """Build the merged matrices of all stretches, with equal capacity."""
    room = FEWEST
    while True:
        merged = [merger.merge(pairs, room) for pairs in found]
        most = max(len(one.keys) for one in merged)
        if most == room:
            return jax.tree.map(lambda *parts: jnp.stack(parts), *merged)
        room = most


def with_lists(scene: Scene, lists: Lists | None, near: Near | None) -> Scene:
    """Insert the `lists` of one stretch, and an empty site list `near`, in the scene."""
    if lists is None or near is None:
        return scene
    assert scene.contact is not None
    # The run has checked that its steps pass through nothing, so a replay does not use these fold angles.
    unknown = jnp.full_like(scene.contact.candidates.theta, jnp.nan), jnp.asarray(jnp.nan, float)
    candidates = Candidates(lists.triangles, lists.count, near.around, lists.folded, *unknown)
    scene = eqx.tree_at(lambda s: s.contact.candidates, scene, candidates)
    scene = with_near(scene, near)
    return eqx.tree_at(
        lambda s: s.pattern.contact.merged, scene, lists.merged, is_leaf=lambda leaf: leaf is None
    )


def near_step(scene: Scene, old: Array, new: Array, between: Array | bool) -> Scene:
    """Build the site list of one step in the scene of its stretch.

    `old`, `new` (n, 3): recorded positions in m at the ends of the step; `between`: whether the step also
    uses positions between them."""
    if scene.contact is None:
        return scene
    reach = SLACK * scene.contact.range + jnp.where(between, motion(old, new), 0.0)
    around = jax.lax.stop_gradient(Around(new, reach))
    scene = eqx.tree_at(lambda s: s.contact.candidates.around, scene, around)
    assert scene.contact is not None
    return with_near(scene, find_near(jax.lax.stop_gradient(scene.contact), around))


def as_listed(scene: Scene, listed: Scene) -> Scene:
    """Return the scene with the contact lists of another scene."""
    if scene.contact is None or listed.contact is None:
        return scene
    theirs = listed.contact.candidates, listed.contact.near, listed.pattern.contact
    return eqx.tree_at(lambda s: (s.contact.candidates, s.contact.near, s.pattern.contact), scene, theirs)
