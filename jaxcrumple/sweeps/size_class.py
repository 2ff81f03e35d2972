"""Size classes: arrays of equal sizes for sheets whose random meshes differ, so that one program fits all."""

from collections.abc import Hashable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax

from jaxcrumple.scene import Scene


class SizeClass(NamedTuple):
    """Hold the array sizes in which random meshes of equal numbers of nodes differ.

    - `entries`, `neighbors` of the tangent; `cells`, `members`, `functions` of its coarse space.
    - `around`, `ways`: of the fans of contact, 0 without.
    """

    entries: int
    neighbors: int
    cells: int
    members: int
    functions: int
    around: int
    ways: int

    @classmethod
    def of(cls, scenes: Sequence[Scene]) -> "SizeClass":
        """Return the least sizes that hold all scenes."""
        return cls(*map(max, zip(*map(_sizes, scenes), strict=True)))

    def padded(self, scene: Scene) -> Scene:
        """Return the scene with arrays of these sizes, before it has lists. What is added has no effect."""
        if self == _sizes(scene):
            return scene
        coarse = scene.pattern.coarse.padded(self.cells, self.members, self.functions)
        scene = eqx.tree_at(
            lambda s: s.pattern, scene, scene.pattern.padded(self.entries, self.neighbors, coarse)
        )
        if scene.contact is None:
            return scene
        fans = scene.contact.fans.padded(self.around, self.ways)
        return eqx.tree_at(lambda s: s.contact.fans, scene, fans)


def kind_of(scene: Scene, other: Any) -> Hashable:
    """Return what scenes without lists share if one size class holds them; `other`: a tree to share, too."""
    pattern = scene.pattern
    own = [pattern.indices, pattern.rows, pattern.entry_places, pattern.neighbors, pattern.row_entries]
    own += [] if scene.contact is None else jax.tree.leaves(scene.contact.fans)
    free = set(map(id, own))
    scene = eqx.tree_at(lambda s: s.pattern.coarse, scene, None)
    leaves, tree = jax.tree.flatten((scene, other))
    return tree, tuple(None if id(leaf) in free else _shape(leaf) for leaf in leaves)


def _shape(leaf: Any) -> Hashable:
    return (leaf.shape, str(leaf.dtype)) if eqx.is_array(leaf) else leaf


def _sizes(scene: Scene) -> SizeClass:
    pattern, contact = scene.pattern, scene.contact
    around, ways = (0, 0) if contact is None else (contact.fans.hinges.shape[1], len(contact.fans.ends))
    cells, members = pattern.coarse.members.shape
    return SizeClass(
        pattern.nnz, pattern.neighbors.shape[1], cells, members, pattern.coarse.size, around, ways
    )
