"""Give scenes of different meshes equal array sizes, so that one program runs them as lanes."""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx

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


def _sizes(scene: Scene) -> SizeClass:
    pattern, contact = scene.pattern, scene.contact
    around, ways = (0, 0) if contact is None else (contact.fans.hinges.shape[1], len(contact.fans.ends))
    cells, members = pattern.coarse.members.shape
    return SizeClass(
        pattern.nnz, pattern.neighbors.shape[1], cells, members, pattern.coarse.size, around, ways
    )
